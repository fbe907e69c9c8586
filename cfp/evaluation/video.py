"""One episode of a policy, recorded as it is evaluated: its film and its replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO, TypeVar

import numpy as np

from cfp.config import RunConfig
from cfp.envs.make import make_torch_env
from cfp.errors import ConfigError
from cfp.evaluation.returns import Noise, SeededPolicy, evaluation_seed, without_noise
from cfp.messages import say
from cfp.policy import Policy
from dittogym import TorchEnv
from dittogym.render.film import VideoUnavailable
from dittogym.render.recording import OPTIONS, Act, FilmOptions, Recording, attached, record

Recorded = TypeVar("Recorded")


def record_policy(config: RunConfig, policy: Policy, noise: Noise = "default") -> Recording:
    """The first episode of the policy's evaluation; of one made for a single layout, that layout."""
    seed = policy.description.get("layout", evaluation_seed(config))
    return record_episode(config, policy, without_noise(policy, noise), seed, record)


def record_episode(
    config: RunConfig,
    policy: Policy,
    deterministic: bool,
    seed: int,
    recorder: Callable[[TorchEnv, Act, int], Recorded],
) -> Recorded:
    """One episode of a policy."""
    env = make_torch_env(config, policy.resolution, 1)
    acting, memory = SeededPolicy(attached(policy, env), seed), None

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal memory
        action, memory = acting.predict(observation, memory, deterministic=deterministic)
        return action

    return recorder(env, act, seed)


def check_files(paths: Mapping[str, Path | None], options: Mapping[str, Any]) -> None:
    """Check the arguments of `save_media`.

    Raises:
        ConfigError: A file has another suffix than what it is to hold, or an option is out of range or has no effect
            on any of the files.
    """
    films = (".mp4", ".gif", ".webp", ".png")
    for name, path in paths.items():
        allowed = (".html",) if name == "replay" else films
        if path is not None and path.suffix not in allowed:
            raise ConfigError(f"{name} must end in {' or '.join(allowed)}, got {path}")
    for name in options:
        if not any(path is not None and name in OPTIONS[path.suffix] for path in paths.values()):
            suffixes = " or ".join(suffix for suffix, names in OPTIONS.items() if name in names)
            raise ConfigError(f"{name} requires a file that ends in {suffixes}, got none")
    try:
        FilmOptions(**options)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def save_media(
    recording: Recording, paths: Mapping[str, Path | None], output: TextIO | None = None, **options: Any
) -> None:
    """Write an episode to files and print their names; where MP4 cannot be written, print why.

    Args:
        recording: The episode.
        paths: Files by what they hold, ``video`` and ``replay``; None: not wanted.
        output: Where to print; None: the standard output.
        options: See `dittogym.render.recording.FilmOptions`.
    """
    for name, path in paths.items():
        try:
            if path is not None:
                say(f"{name}: {recording.save(path, **options)}", output)
        except VideoUnavailable as error:
            say(f"no {name}: {error}", output)
