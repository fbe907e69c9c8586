"""The coarse-to-fine policy (CFP): soft actor-critic on action images whose resolution grows level by level."""

from cfp.agent.features import ImageFeatures
from cfp.agent.hyperparameters import Hyperparameters
from cfp.agent.policies import ActorPolicy, CFPPolicy
from cfp.agent.sac import CFP
from cfp.agent.spec import ActorSpec
from cfp.config import Config
from cfp.envs.vec_env import TorchVecEnv
from cfp.errors import CFPError, CheckpointError, ConfigError, NonFiniteError
from cfp.presets import preset
from cfp.weights import load

__all__ = [
    "CFP",
    "ActorPolicy",
    "ActorSpec",
    "CFPError",
    "CFPPolicy",
    "CheckpointError",
    "Config",
    "ConfigError",
    "Hyperparameters",
    "ImageFeatures",
    "NonFiniteError",
    "TorchVecEnv",
    "load",
    "preset",
]
