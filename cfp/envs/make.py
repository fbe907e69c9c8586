"""Environments from the options of a run, and its random numbers."""

from __future__ import annotations

import functools
import logging
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecMonitor

from cfp.config import TASK_OPTIONS, RunConfig
from cfp.envs.vec_env import monitored
from cfp.errors import ConfigError
from dittogym import TorchEnv
from dittogym.render.recording import generators_kept
from dittogym.torch_env import find_device
from torchmpm.solver import kernels_fail

_logger = logging.getLogger(__name__)


def choose_device(name: str) -> str:
    """Resolve ``"auto"``: CUDA if there is a GPU that the kernels of the physics run on, else the CPU.

    Without them a GPU would be slower than a CPU. The log says once why a GPU is not used.
    """
    if name == "auto":
        return _automatic_device()
    try:
        return str(find_device(name))
    except ValueError as error:
        raise ConfigError(f"{error}; auto chooses one") from error


@functools.cache
def _automatic_device() -> str:
    if not torch.cuda.is_available():
        return "cpu"
    reason = kernels_fail(torch.device("cuda", torch.cuda.current_device()))
    if reason is not None:
        _logger.warning("device auto is the CPU, because the physics would be slow on the GPU: %s", reason)
    return "cuda" if reason is None else "cpu"


def gpu_memory(device: str) -> int | None:
    """Bytes of memory of the GPU that ``device`` stands for; 0: it is the CPU, None: there is no such GPU."""
    try:
        found = choose_device(device)
    except ConfigError:
        return None if device.startswith("cuda") else 0
    return 0 if found == "cpu" else int(torch.cuda.get_device_properties(found).total_memory)


def make_env(
    config: RunConfig,
    resolution: int,
    num_envs: int | None = None,
    max_episode_steps: int | None = None,
    tensors: bool = False,
    **changes: Any,
) -> VecMonitor:
    """Create the environment of a run for stable-baselines3, see `make_torch_env` and `TorchVecEnv`."""
    return monitored(make_torch_env(config, resolution, num_envs, **changes), max_episode_steps, tensors)


def make_torch_env(config: RunConfig, resolution: int, num_envs: int | None = None, **changes: Any) -> TorchEnv:
    """Make the environment of a run, on the device that its options choose.

    Args:
        config: Options of the run.
        resolution: R, rows and columns of an action.
        num_envs: Number of simulations; None for that of the options.
        changes: Further options of `dittogym.TorchEnv`, such as ``conditions``.

    Raises:
        cfp.ConfigError: An option is out of range, or does not exist.
    """
    options = {name: value for name, value in vars(config.environment).items() if name not in TASK_OPTIONS}
    options |= config.environment.task_options() | changes
    options |= {"num_envs": num_envs or options["num_envs"], "device": choose_device(config.device)}
    try:
        return TorchEnv(config.task, resolution=resolution, **options)
    except (ValueError, TypeError, OSError) as error:
        raise ConfigError(" ".join(str(error).split())) from error


@contextmanager
def all_generators_kept() -> Iterator[None]:
    """Restore the global generators of torch, NumPy and Python, which stable-baselines3 seeds."""
    numbers, choices = np.random.get_state(), random.getstate()  # noqa: NPY002
    try:
        with generators_kept():
            yield
    finally:
        np.random.set_state(numbers)  # noqa: NPY002
        random.setstate(choices)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch's generators, and restore them afterwards."""
    with generators_kept():
        torch.manual_seed(seed)
        yield
