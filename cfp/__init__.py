"""The coarse-to-fine policy (CFP): action images of increasing resolution, learned by gradients or from rewards."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cfp.agent.actor import ActorSpec
from cfp.config import AnalyticConfig, CoarseToFineConfig, Hyperparameters, SACConfig
from cfp.errors import CFPError, CheckpointError, ConfigError, NonFiniteError
from cfp.policy import ActorPolicy, load
from cfp.presets import preset

if TYPE_CHECKING:
    from cfp.agent.features import ImageFeatures
    from cfp.analytic.learner import CFPAnalytic
    from cfp.envs.vec_env import TorchVecEnv
    from cfp.evaluation.returns import evaluate_policy
    from cfp.runs import Run, fit
    from cfp.sac.learner import CFP
    from cfp.sac.policies import CFPPolicy

__all__ = [
    "CFP",
    "ActorPolicy",
    "ActorSpec",
    "AnalyticConfig",
    "CFPAnalytic",
    "CFPError",
    "CFPPolicy",
    "CheckpointError",
    "CoarseToFineConfig",
    "ConfigError",
    "Hyperparameters",
    "ImageFeatures",
    "NonFiniteError",
    "Run",
    "SACConfig",
    "TorchVecEnv",
    "evaluate_policy",
    "fit",
    "load",
    "preset",
]

# Imported on first use: loading a policy needs neither stable-baselines3 nor TensorBoard, which it imports.
_ON_FIRST_USE = {
    "CFP": "cfp.sac.learner",
    "CFPAnalytic": "cfp.analytic.learner",
    "CFPPolicy": "cfp.sac.policies",
    "ImageFeatures": "cfp.agent.features",
    "Run": "cfp.runs",
    "evaluate_policy": "cfp.evaluation.returns",
    "fit": "cfp.runs",
    "TorchVecEnv": "cfp.envs.vec_env",
}


def __getattr__(name: str) -> Any:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_ON_FIRST_USE[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
