"""Interactive forces on a robot: pulling at matter, driving muscles near a point, and waves of contraction."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from torchmpm import ParticleState

#: The hand takes hold of the particle nearest to the pointer, at most so far away, and of those as near to that one, m.
REACH = 0.045
#: Angular frequency of the spring between hand and matter, 1/s; it is damped critically.
SPRING = 20.0
#: Largest acceleration of held matter, m/s^2; more would tear it off.
LARGEST_ACCELERATION = 400.0
#: Smallest distance over which the strength of driven muscles falls off, m.
MUSCLE_REACH = 0.03
#: Phase that a wave advances in a control step, and wavelengths in the action image.
WAVE_SPEED, WAVE_NUMBER = 0.3, 2.0

Direction: TypeAlias = Literal["left", "right", "up", "down"]


@dataclass(frozen=True)
class Grip:
    """Particles that are pulled at."""

    indices: Tensor  # (n,) of the particles held
    weights: Tensor  # (n, 1), from 0 to 1
    offset: Tensor  # (2,), m, from their weighted centre to the place at which they are held
    hanging: Tensor  # indices of what moves along: all of the robot, or of other matter only what is held

    @classmethod
    def take(cls, state: ParticleState, point: Tensor, num_robot: int) -> Grip | None:
        """Take hold of matter at a point (2,) of the world, m; ``None`` where there is none.

        What is held is around the particle that is nearest to the point: of the robot, the first ``num_robot``
        particles, or of everything else.
        """
        x = state.x[0]
        distance = (x - point).norm(dim=1).nan_to_num(torch.inf)
        nearest = int(distance.argmin())
        if distance[nearest] > REACH:
            return None
        distance = (x - x[nearest]).norm(dim=1)  # so that there is enough to hold at an edge, too
        of_robot = torch.arange(len(x), device=x.device) < num_robot
        indices = ((distance < REACH) & (of_robot == of_robot[nearest])).nonzero()[:, 0]
        weights = 1.0 - (distance[indices, None] / REACH).square()
        hanging = of_robot.nonzero()[:, 0] if nearest < num_robot else indices
        return cls(indices, weights, point - (weights * x[indices]).sum(0) / weights.sum(), hanging)

    def pull(self, state: ParticleState, point: Tensor, duration: float) -> ParticleState:
        """Let a spring to a point (2,), m, act for a ``duration``, s, on the place at which the particles are held.

        Only held particles feel it, but it is as strong as moving everything that hangs on them needs.
        """
        held = (self.weights * state.x[0, self.indices]).sum(0) / self.weights.sum() + self.offset
        speed = state.v[0, self.hanging].mean(0)
        acceleration = SPRING**2 * (point - held) - 2 * SPRING * speed
        acceleration = acceleration * (len(self.hanging) / self.weights.sum())
        acceleration = acceleration * (LARGEST_ACCELERATION / acceleration.norm().clamp_min(LARGEST_ACCELERATION))
        v = state.v.clone()
        v[0, self.indices] += duration * self.weights * acceleration
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
