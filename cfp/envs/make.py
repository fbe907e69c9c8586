"""From a run's options to environments."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from stable_baselines3.common.vec_env import VecMonitor

from cfp.config import RunConfig
from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError
from cfp.sections import TASK_OPTIONS
from dittogym import TorchEnv


def choose_device(name: str) -> str:
    """Resolve ``"auto"`` to CUDA where there is one.

    Raises:
        ConfigError: CUDA is asked for and there is none, or torch does not know the name.
    """
    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        kind = torch.device(name).type
    except RuntimeError as error:
        raise ConfigError(f"device: got {name!r}, allowed auto, cpu or cuda") from error
    if kind == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device: got {name!r}, but torch finds no CUDA device; allowed here: auto, cpu")
    return name


def make_env(config: RunConfig, resolution: int, num_envs: int | None = None) -> VecMonitor:
    """Build the environment of a run for stable-baselines3, see `make_torch_env`."""
    return monitored(make_torch_env(config, resolution, num_envs))


def make_torch_env(config: RunConfig, resolution: int, num_envs: int | None = None, **changes: Any) -> TorchEnv:
    """Build the environment of a run.

    Args:
        config: The run's options.
        resolution: Action grid R.
        num_envs: Robots side by side; the run's own number if None.
        changes: Options of `dittogym.TorchEnv` that are not the run's, such as ``obstacles``.

    Raises:
        ConfigError: The environment refuses an option; the message is its own.
    """
    options = dataclasses.asdict(config.environment)
    own = options.pop("num_envs")
    for name in TASK_OPTIONS:
        options.pop(name)
    options |= config.environment.task_options() | changes
    device = choose_device(config.device)
    try:
        return TorchEnv(config.task, num_envs or own, resolution, device=device, **options)
    except (ValueError, TypeError, OSError) as error:
        raise ConfigError(" ".join(str(error).split())) from error
