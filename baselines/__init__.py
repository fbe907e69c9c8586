"""Other algorithms, with the command lines, run folders and policy interface of the coarse-to-fine policy."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors
    from baselines.common.open_loop import OpenLoop
    from baselines.distillation.learner import Distill, DistillConfig
    from baselines.modular.learner import ModularConfig
    from baselines.modular.networks import SegmentPolicy
    from baselines.planning.cem import CEMPlanner, CEMPlannerConfig
    from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig
    from baselines.planning.mpc import CEM, MPC, CEMConfig, MPCConfig
    from baselines.registry import ALGORITHMS, load
    from baselines.runs import Run, fit
    from baselines.shac import Shac, ShacConfig, StatePolicy
    from baselines.trajectory import Gradient, GradientConfig
    from cfp.learner import Learner

#: Where each public name is; its module is imported when it is used, so that ``torchmpm --help`` is quick.
_MODULES = {
    "ALGORITHMS": "baselines.registry",
    "Learner": "cfp.learner",
    "CEM": "baselines.planning.mpc",
    "CEMConfig": "baselines.planning.mpc",
    "CEMPlanner": "baselines.planning.cem",
    "CEMPlannerConfig": "baselines.planning.cem",
    "Distill": "baselines.distillation.learner",
    "DistillConfig": "baselines.distillation.learner",
    "Gradient": "baselines.trajectory",
    "GradientConfig": "baselines.trajectory",
    "GradientPlanner": "baselines.planning.gradient",
    "GradientPlannerConfig": "baselines.planning.gradient",
    "MPC": "baselines.planning.mpc",
    "MPCConfig": "baselines.planning.mpc",
    "ModularConfig": "baselines.modular.learner",
    "OpenLoop": "baselines.common.open_loop",
    "Run": "baselines.runs",
    "SegmentPolicy": "baselines.modular.networks",
    "Shac": "baselines.shac",
    "ShacConfig": "baselines.shac",
    "StatePolicy": "baselines.shac",
    "fit": "baselines.runs",
    "load": "baselines.registry",
}

__all__ = [
    "ALGORITHMS",
    "CEM",
    "MPC",
    "CEMConfig",
    "CEMPlanner",
    "CEMPlannerConfig",
    "Distill",
    "DistillConfig",
    "Gradient",
    "GradientConfig",
    "GradientPlanner",
    "GradientPlannerConfig",
    "Learner",
    "MPCConfig",
    "ModularConfig",
    "OpenLoop",
    "Run",
    "SegmentPolicy",
    "Shac",
    "ShacConfig",
    "StatePolicy",
    "fit",
    "load",
]


def __getattr__(name: str) -> Any:
    """Import a public name."""
    if name not in _MODULES:
        raise AttributeError(f"module 'baselines' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
