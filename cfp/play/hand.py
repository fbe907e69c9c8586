"""Interactive forces on a robot: pulling at matter, driving muscles near a point, and waves of contraction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from torch import Tensor

from torchmpm import ParticleState

#: Matter within this distance of the pointer is pulled along, m.
REACH = 0.045
#: Speed at which matter follows the pointer, per metre of distance to it, 1/s.
HASTE = 15.0
#: Largest speed of matter that is pulled, m/s.
LARGEST_SPEED = 2.0
#: Smallest distance over which the strength of driven muscles falls off, m.
MUSCLE_REACH = 0.03
#: Phase that a wave advances in a control step, and wavelengths in the action image.
WAVE_SPEED, WAVE_NUMBER = 0.3, 2.0

Direction: TypeAlias = Literal["left", "right", "up", "down"]


@dataclass(frozen=True)
class Grip:
    """Particles that are pulled at.

    Their indices (n,), weights (n, 1) from 0 to 1, and the ``offset`` (2,), m, from their weighted centre to the place
    at which they are held.
    """

    indices: Tensor
    weights: Tensor
    offset: Tensor

    @classmethod
    def take(cls, state: ParticleState, point: Tensor) -> Grip | None:
        """Take hold of the particles around a point (2,) of the world, m; ``None`` where there are none."""
        x = state.x[0]
        distance = (x - point).norm(dim=1)
        indices = (distance < REACH).nonzero()[:, 0]  # never those that are not finite
        if not len(indices):
            return None
        weights = 1.0 - (distance[indices, None] / REACH).square()
        return cls(indices, weights, point - (weights * x[indices]).sum(0) / weights.sum())

    def pull(self, state: ParticleState, point: Tensor) -> ParticleState:
        """Give the particles a velocity with which the place they are held at goes to a point (2,), m."""
        held = (self.weights * state.x[0, self.indices]).sum(0) / self.weights.sum() + self.offset
        velocity = HASTE * (point - held)
        velocity = velocity * (LARGEST_SPEED / velocity.norm().clamp_min(LARGEST_SPEED))
        v = state.v.clone()
        v[0, self.indices] += self.weights * (velocity - v[0, self.indices])
        return replace(state, v=v)


def press(point: np.ndarray, corner: np.ndarray, width: float, size: int) -> np.ndarray:
    """Action (2, size, size) that contracts all muscles around a point.

    Args:
        point: (2,) in the world, m.
        corner: Lower left corner (2,) of the action image in the world, m.
        width: Its width, m.
        size: Its rows and columns, row 0 at the top.
    """
    along = (np.arange(size) + 0.5) * width / size
    x, y = corner[0] + along - point[0], corner[1] + along[::-1] - point[1]
    strength = np.exp(-(x**2 + y[:, None] ** 2) / (2 * reach(width, size)["muscles"] ** 2))
    return np.broadcast_to(strength, (2, size, size))


def reach(width: float, size: int) -> dict[str, float]:
    """Distances from the pointer within which the hand pulls at matter, and over which its effect on muscles falls off.

    Args:
        width: Width of the action image, m.
        size: Its rows and columns.
    """
    return {"pull": REACH, "muscles": max(MUSCLE_REACH, 0.6 * width / size)}


def wave(direction: Direction, step: int, size: int) -> np.ndarray:
    """Action (2, size, size) of waves of contraction that travel in a direction, of vertical muscles a bit later."""
    along = np.arange(size) / size
    position = {"right": along, "left": -along, "up": -along[:, None], "down": along[:, None]}[direction]
    phase = 2 * np.pi * WAVE_NUMBER * np.broadcast_to(position, (size, size)) - WAVE_SPEED * step
    return np.sin(phase - 2.0 * np.arange(2)[:, None, None])
