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
    """Refuse what cannot start where it is.

    Raises:
        ValueError: A body leaves the window or overlaps an obstacle, the robot reaches into the bounding box of the
            object or is torn from the start, or the goal lies outside a fixed window.
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
            free = f"{low[0]:.3f} < x < {high[0]:.3f}, {low[1]:.3f} < y < {high[1]:.3f}"
            raise ValueError(f"robot must leave the place of the object free, {free}, got {place}")
    split, limit = float(np.sqrt(points.var(0).sum())), spec.split_limit
    if limit is not None and split >= limit:
        raise ValueError(f"robot must be more compact: its spread is {split:.3f} m, and {spec.name} ends at {limit} m")
    if spec.goal is not None and not spec.window.moves and not bool(contains(origin.new_tensor([[spec.goal]]), origin)):
        raise ValueError(f"goal must lie inside the window ({window_range(origin)}), got {spec.goal}")


def _checked_place(spec: TaskSpec, name: str, body: BodySpec, points: np.ndarray, origin: torch.Tensor) -> str:
    """Where a body lies, with points (N, 2): inside the window at ``origin`` (1, 2) and outside the obstacles."""
    (left, bottom), (width, height) = body.shape.corner, body.shape.size
    place = f"{left:.3f} < x < {left + width:.3f}, {bottom:.3f} < y < {bottom + height:.3f}"
    corners = origin.new_tensor([[(left, bottom), (left + width, bottom + height)]])
    if not bool(contains(corners, origin).all()):
        raise ValueError(f"{name} must lie inside the window ({window_range(origin)}), got {place}")
    for obstacle in spec.obstacles:
        for box in () if obstacle.rules == () else obstacle.boxes:
            if _any_inside(points, (box.left, box.bottom), (box.right, box.top)):
                solid = f"{box.left:.4g} < x < {box.right:.4g}, {box.bottom:.4g} < y < {box.top:.4g}"
                raise ValueError(f"{name} must start outside the obstacle {obstacle.name!r} ({solid}), got {place}")
    return place


def window_range(origin: torch.Tensor) -> str:
    """What lies inside a window at ``origin`` (1, 2), m, for messages."""
    return f"{origin[0, 0]:.3f} < x < {origin[0, 0] + 1:.3f}, 0 < y < 1"


def _any_inside(points: np.ndarray, low: npt.ArrayLike, high: npt.ArrayLike) -> bool:
    return bool(((points > low) & (points < high)).all(1).any())
