"""Recording an episode as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from dittogym.bodies.positions import MAX_SEED
from dittogym.env import Env, as_tensor
from dittogym.render.recording import Act, as_function, play
from dittogym.torch_env import TorchEnv
from torchmpm import checks

#: Attributes of :class:`torchmpm.ParticleState`.
FIELDS = ("x", "v", "C", "F", "Jp")


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of T steps of a simulation of N particles.

    Attributes:
        observations: (T + 1, 3, 64, 64) uint8, from the reset to the end.
        actions: (T, 2, R, R), as the policy chose them.
        rewards: (T,).
        terminations: (T,) bool, whether the task ended the episode.
        truncations: (T,) bool, whether the time limit ended it.
        particles: Of the states, by name: ``x`` (T + 1, N, 2) in m, ``v`` (T + 1, N, 2) in m/s, and others on request.
        seed: Seed of the reset.
        task: Name of the task.
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray
    particles: dict[str, np.ndarray]
    seed: int
    task: str


def record(env: Any, policy: Any, *, seed: int = 0, fields: Sequence[str] = ("x", "v")) -> Episode:
    """Reset an environment, play an episode, and record it as arrays.

    Args:
        env: A :class:`dittogym.TorchEnv` of one simulation, or a Gymnasium environment of this package. Its wrappers
            have no part in it.
        policy: A function of observations or an object with a method ``predict``, see :meth:`dittogym.TorchEnv.film`.
        seed: Seed of the reset and of the policy's noise.
        fields: Of the particles, which to keep after each step: any of ``x``, ``v``, ``C``, ``F`` and ``Jp``.

    Raises:
        TypeError: The environment or the policy is of another kind.
        ValueError: The environment has more than one simulation, or there is no such field.
    """
    seed = checks.whole("seed", seed, 0, MAX_SEED)  # a file stores it as a number
    inner: Any = env.unwrapped if isinstance(env, gymnasium.Env) else env
    torch_env = inner.torch_env if isinstance(inner, Env) else inner
    if not isinstance(torch_env, TorchEnv):
        raise TypeError(f"env must be a TorchEnv or a Gymnasium environment of this package, got {env!r}")
    act = as_function(policy, torch_env.action_layout)
    if isinstance(inner, Env):
        return record_batch(torch_env, lambda images: as_tensor(act(images[0]), torch_env, single=True), seed, fields)
    return record_batch(torch_env, act, seed, fields)


def record_batch(env: TorchEnv, act: Act, seed: int, fields: Sequence[str]) -> Episode:
    """As :func:`record`, for a batch of one: ``act`` maps observations (1, 3, 64, 64) to actions (1, 2, R, R)."""
    if env.num_envs != 1:
        raise ValueError(f"env must have 1 simulation, got {env.num_envs}")
    if unknown := [name for name in fields if name not in FIELDS]:
        raise ValueError(f"fields must be among {', '.join(FIELDS)}, got {', '.join(unknown)}")

    def state() -> list[np.ndarray]:
        return [getattr(env.state, name)[0].cpu().numpy().copy() for name in fields]

    observations, actions, ends, states = [], [], [], []
    for images, chosen, end in play(env, act, seed):
        observations.append(images.copy())
        states.append(state())
        if chosen is not None:
            actions.append(chosen.copy())
            ends.append([value.item() for value in end[:3]])
    rewards, terminations, truncations = (np.array(values) for values in zip(*ends, strict=True))
    particles = {name: np.stack(values) for name, values in zip(fields, zip(*states, strict=True), strict=True)}
    images, done = np.concatenate(observations), (terminations, truncations)
    return Episode(images, np.concatenate(actions), rewards, *done, particles, seed, env.spec.name)
