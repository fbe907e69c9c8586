"""The faults of the reference implementation beside its dynamics and rewards, to follow its recordings.

The library keeps the reference's dynamics and rewards and mends what hides the truth. Its recordings, however, were
made with these faults, which :func:`make` brings back:

- every particle has unit volume and full mass, so that a robot of fewer particles is lighter and softer;
- particles are drawn independently, and each sets a pixel of the observation, whatever their number;
- a reset returns the last episode's observation, leaves the centre on which the first action is placed, and lets CATCH
  choose the hand by where the cube ended;
- actions are laid out along the grid, (component, x, y).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

import dittogym
from dittogym import core
from dittogym.bodies.positions import Particles, particle_counts
from dittogym.core import EnvState
from dittogym.env import as_numpy, first

#: What CATCH remembers of the last episode.
STALE = ("object_com",)
#: Options of tasks, which are not those of the environment.
TASK_OPTIONS = ("body", "obstacles", "target", "fit", "variant")


def make(task: str, resolution: str | int = "coarse", *, particles: Particles = "full", **options: Any) -> ReferenceEnv:
    """An environment that does what the reference implementation does.

    Args:
        task: Name of the task.
        resolution: ``"coarse"``, ``"fine"`` or the number of cells.
        particles: As in :class:`dittogym.TorchEnv`.
        options: Further options of :class:`dittogym.Env` and of the task.
    """
    spec = dittogym.make_spec(task, **{name: options.pop(name) for name in TASK_OPTIONS if name in options})
    robot, *objects = (
        replace(body, count=count)  # now full size, at which the library's physics and observation are the reference's
        for body, count in zip(spec.bodies, particle_counts(spec, particles), strict=True)
    )
    spec = replace(spec, robot=robot, objects=tuple(objects))
    return ReferenceEnv(spec, resolution=resolution, **{"action_layout": "grid", **options})


class ReferenceEnv(dittogym.Env):
    """A :class:`dittogym.Env` whose resets show and remember what the last episode left."""

    _image: np.ndarray | None = None
    _positions: np.ndarray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """As :meth:`dittogym.Env.reset`; ``options["positions"]`` may also lie outside the window."""
        env, image = self.torch_env, self._image
        last = None if image is None else env.env_state
        options = dict(options or {})
        if "positions" in options or seed is not None:
            self._positions = options.pop("positions", None)
        observation, info = super().reset(seed=seed, options=options)
        if self._positions is not None:  # one recording parks particles that it does not need outside
            given = torch.as_tensor(np.asarray(self._positions))[None].to(env.state.x)
            env.env_state, seen = core.reset(env.model, given, env.env_state.physics)
            described = core.info_of(env.model, env.env_state, env.env_state.start)
            observation, info = first(as_numpy(seen)), first(as_numpy(described))
        if image is None or last is None:
            self._image = observation
            return observation, info
        env.env_state = _with_the_past(env.env_state, last)
        return image, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """As :meth:`dittogym.Env.step`."""
        result = super().step(action)
        self._image = result[0]
        return result


def _with_the_past(state: EnvState, last: EnvState) -> EnvState:
    """A new episode's state with what a reset of the reference leaves as it was."""
    stale = {name: last.task_state[name] for name in STALE if name in state.task_state}
    return replace(state, centre=last.centre, task_state={**state.task_state, **stale})
