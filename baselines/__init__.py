"""Algorithms to compare the coarse-to-fine policy with, behind the same command lines, folders and policies."""

from baselines.common.open_loop import OpenLoop
from baselines.distillation.train import Distill, DistillConfig
from baselines.modular.policy import SegmentPolicy
from baselines.modular.train import ModularConfig
from baselines.planning.cem import CEMPlanner, CEMPlannerConfig
from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig
from baselines.planning.mpc import CEM, MPC, CEMConfig, MPCConfig
from baselines.registry import ALGORITHMS, load
from baselines.shac.networks import StatePolicy
from baselines.shac.train import Shac, ShacConfig
from baselines.trajectory.optimise import Gradient, GradientConfig

__all__ = [
    "ALGORITHMS",
    "CEM",
    "MPC",
    "Algorithm",
    "CEMConfig",
    "CEMPlanner",
    "CEMPlannerConfig",
    "Distill",
    "DistillConfig",
    "Gradient",
    "GradientConfig",
    "GradientPlanner",
    "GradientPlannerConfig",
    "MPCConfig",
    "ModularConfig",
    "OpenLoop",
    "SegmentPolicy",
    "Shac",
    "ShacConfig",
    "StatePolicy",
    "load",
]
