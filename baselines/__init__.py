"""Algorithms to compare the coarse-to-fine policy with, behind the same command lines, folders and policies."""

from importlib import import_module
from typing import Any

from baselines.registry import ALGORITHMS, load

_MODULES = {
    "Algorithm": "cfp.experiment.algorithm",
    "CEM": "baselines.planning.mpc",
    "CEMConfig": "baselines.planning.mpc",
    "CEMPlanner": "baselines.planning.cem",
    "CEMPlannerConfig": "baselines.planning.cem",
    "Distill": "baselines.distillation.train",
    "DistillConfig": "baselines.distillation.config",
    "Gradient": "baselines.trajectory.optimise",
    "GradientConfig": "baselines.trajectory.optimise",
    "GradientPlanner": "baselines.planning.gradient",
    "GradientPlannerConfig": "baselines.planning.gradient",
    "MPC": "baselines.planning.mpc",
    "MPCConfig": "baselines.planning.mpc",
    "ModularConfig": "baselines.modular.train",
    "OpenLoop": "baselines.common.open_loop",
    "SegmentPolicy": "baselines.modular.networks",
    "Shac": "baselines.shac.train",
    "ShacConfig": "baselines.shac.train",
    "StatePolicy": "baselines.shac.networks",
}
"""Where each public class is; its module is imported when it is used."""

__all__ = ["ALGORITHMS", "load", *_MODULES]


def __getattr__(name: str) -> Any:
    """Import a public class."""
    if name not in _MODULES:
        raise AttributeError(f"module 'baselines' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)
