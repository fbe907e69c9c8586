"""The coarse-to-fine policy (CFP): soft actor-critic on action images whose resolution grows level by level."""

from cfp.actor import ActorSpec
from cfp.algorithm import CFP
from cfp.config import Config
from cfp.errors import CFPError, CheckpointError, ConfigError, NonFiniteError
from cfp.features import ImageFeatures
from cfp.policy import ActorPolicy, CFPPolicy
from cfp.presets import preset
from cfp.vec_env import TorchVecEnv
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
    "ImageFeatures",
    "NonFiniteError",
    "TorchVecEnv",
    "load",
    "preset",
]
