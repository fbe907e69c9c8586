"""Whether the bodies of a task can start where they are."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch

from dittogym.spec import BodySpec, TaskSpec
from dittogym.window import contains
from torchmpm import sampling

#: Points with which a shape is measured.
PROBE = 4096


def check_place(spec: TaskSpec) -> None:
    """Refuse bodies that leave the window or overlap an obstacle, and a robot in the object or torn from the start.

    Raises:
        ValueError: There is such a body.
    """
    numbers = sampling.sobol(PROBE, seed=0)
    points = spec.robot.shape.positions(numbers)
    origin = spec.window.origin(torch.from_numpy(points.mean(0, keepdims=True)))
    place = _checked_place(spec, "robot", spec.robot, points, origin)
    for index, other in enumerate(spec.objects):
        _checked_place(spec, f"objects[{index}]", other, other.shape.positions(numbers), origin)
        low = np.array(other.shape.corner)
        high = low + other.shape.size
        if _any_inside(points, low, high):
            free = f"{low.round(4).tolist()} to {high.round(4).tolist()}"
            raise ValueError(f"robot must leave the place of the object free, {free}, got {place}")
    split, limit = float(np.sqrt(points.var(0).sum())), spec.split_limit
    if limit is not None and split >= limit:
        raise ValueError(f"robot must be more compact: its spread is {split:.3f} m, and {spec.name} ends at {limit} m")


def _checked_place(spec: TaskSpec, name: str, body: BodySpec, points: np.ndarray, origin: torch.Tensor) -> str:
    """Where a body lies, with points (N, 2): inside the window at ``origin`` (1, 2) and outside the obstacles."""
    (left, bottom), (width, height) = body.shape.corner, body.shape.size
    place = f"{left:.3f} < x < {left + width:.3f}, {bottom:.3f} < y < {bottom + height:.3f}"
    corners = origin.new_tensor([[(left, bottom), (left + width, bottom + height)]])
    if not bool(contains(corners, origin).all()):
        window = f"{origin[0, 0]:.3f} < x < {origin[0, 0] + 1:.3f}, 0 < y < 1"
        raise ValueError(f"{name} must lie inside the window ({window}), got {place}")
    for obstacle in spec.obstacles:
        for box in obstacle.boxes:
            if _any_inside(points, (box.left, box.bottom), (box.right, box.top)):
                solid = f"{box.left:.4g} < x < {box.right:.4g}, {box.bottom:.4g} < y < {box.top:.4g}"
                raise ValueError(f"{name} must start outside the obstacle {obstacle.name!r} ({solid}), got {place}")
    return place


def _any_inside(points: np.ndarray, low: npt.ArrayLike, high: npt.ArrayLike) -> bool:
    return bool(((points > low) & (points < high)).all(1).any())
