"""Environments so small that a test takes a moment, and ways to drive and compare them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch

import dittogym
from torchmpm import tree

TASKS = tuple(dittogym.TASKS)
#: Tasks whose window stays where it is.
FIXED = tuple(task for task in TASKS if dittogym.make_spec(task).window.follow is None)
SMALL = {"particles": 120, "substeps": 4}
#: Every condition, with ranges for which each task has room.
ALL = dittogym.Conditions(
    latency=(0, 2),
    action_noise=(0.0, 0.3),
    action_dropout=(0.0, 0.5),
    observation_dropout=(0.0, 0.5),
    mu=(0.8, 1.2),
    yield_stress=(0.5, 1.5),
    gravity=(0.9, 1.1),
    shift=0.01,
    turn=5.0,
    velocity=0.5,
    chance=0.7,
    grid=4,
)


def tiny(task: str | dittogym.TaskSpec, num_envs: int = 1, **options: Any) -> dittogym.TorchEnv:
    """A batch in float64 with few particles."""
    return dittogym.TorchEnv(task, num_envs, **{**SMALL, "dtype": "float64", **options})


def make_vec(task: str = "run", num_envs: int = 2, **options: Any) -> gymnasium.vector.VectorEnv:
    """The same task behind Gymnasium's vector interface."""
    name = f"dittogym/{task}-coarse-v0"
    options = {**SMALL, **options}
    return gymnasium.make_vec(name, num_envs=num_envs, vectorization_mode="vector_entry_point", **options)


def begun(env: Any, seed: int = 0) -> Any:
    """The environment after a reset."""
    env.reset(seed=seed)
    return env


def on_edge(env: dittogym.TorchEnv) -> torch.Tensor:
    """Entries of the picture that rounding of the sums may bring to either of two bytes, (B, 3, 64, 64) bool.

    Such are those of an object at rest: zero velocity is 132, and what is just below is 131.
    """
    state = env.env_state
    arrays = (state.particles.x, state.particles.v, state.origin, state.centre)
    exact = env.model.camera.levels(*(array.double() for array in arrays))
    gap = (exact - exact.round()).abs()
    return (gap > 0) & (gap < 2e-3)  # empty space is exact


def normal(*shape: int, seed: int) -> torch.Tensor:
    """Normally distributed numbers."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def actions(env: dittogym.TorchEnv, steps: int, seed: int = 0) -> torch.Tensor:
    """Random actions (steps, B, 2, R, R)."""
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(steps, env.num_envs, *env.action_shape, generator=generator, dtype=torch.float64)
    return (2 * uniform - 1).to(env.dtype)


def stir(env: dittogym.TorchEnv, seed: int = 0) -> None:
    """Give element i the random velocities of ``seed + i``, about 1 m/s, so that things happen within few substeps."""
    for i in range(env.num_envs):
        env.state.v[i] += normal(*env.state.v[i].shape, seed=seed + i).to(env.dtype)


@torch.no_grad()
def episode(env: dittogym.TorchEnv, seed: int) -> list[Any]:
    """All that a batch of two shows and is over a few steps, one of them reset on the way."""
    rows: list[Any] = [env.reset(seed=seed)]
    stir(env, seed)
    for t, action in enumerate(actions(env, 4, seed)):
        if t == 2:
            rows.append(env.reset(options={"reset_mask": [True, False]}))
        rows += [env.step(action), everything(env)]
    return rows


def set_particles(env: dittogym.TorchEnv, **fields: torch.Tensor) -> None:
    """Put other values in place of fields of the particles."""
    env.env_state = replace(env.env_state, particles=replace(env.state, **fields))


def forget(function: Callable[..., Any]) -> None:
    """Let a function of :func:`torchmpm.backends.cached_tensors` make its tensors anew."""
    inspect.getclosurevars(function).nonlocals["kept"].clear()


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Everything in nested dictionaries and sequences, with its path, as arrays."""
    if isinstance(value, dict):
        for key in value:
            yield from leaves(value[key], f"{path}/{key}")
    elif isinstance(value, (tuple, list)):
        for i, entry in enumerate(value):
            yield from leaves(entry, f"{path}/{i}")
    else:
        yield path, value.detach().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)


def assert_same_bits(ours: Any, theirs: Any) -> None:
    """Two nests of tensors, arrays and numbers are equal to the last bit, in the same places."""
    first, second = list(leaves(ours)), list(leaves(theirs))
    assert [path for path, _ in first] == [path for path, _ in second]
    for (path, a), (_, b) in zip(first, second, strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), path


def everything(env: dittogym.TorchEnv) -> list[torch.Tensor]:
    """Every number that an environment's future depends on."""
    return tree.leaves(env.env_state)
