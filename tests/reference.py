"""The faults of the reference implementation beside its dynamics and rewards, to follow its recordings.

The library keeps the reference's dynamics and rewards and mends what hides the truth. Its recordings, however, were
made with these faults, which :func:`make` brings back:

- every particle has unit volume and full mass, so that a robot of fewer particles is lighter and softer;
- particles are drawn independently, and each sets a pixel of the observation, whatever their number;
- actions are laid out along the grid, (component, x, y).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import dittogym
from dittogym.bodies.positions import Particles, particle_counts


def make(task: str, resolution: str | int = "coarse", *, particles: Particles = "full", **options: Any) -> dittogym.Env:
    """An environment that does what the reference implementation does in its first episode.

    Args:
        task: Name of the task.
        resolution: ``"coarse"``, ``"fine"`` or the number of cells.
        particles: As in :class:`dittogym.TorchEnv`.
        options: Further options of :class:`dittogym.Env`.
    """
    spec = dittogym.make_spec(task)
    robot, *objects = (
        replace(body, count=count)  # now full size, at which the library's physics and observation are the reference's
        for body, count in zip(spec.bodies, particle_counts(spec, particles), strict=True)
    )
    spec = replace(spec, robot=robot, objects=tuple(objects))
    return dittogym.Env(spec, resolution=resolution, action_layout="grid", **options)
