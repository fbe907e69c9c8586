"""Velocity rules on grid nodes: floors, ceilings, walls and boxes, from data.

The native kernels have the same formulas in ``native/common/node.hpp``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any, Literal

import torch
from torch import Tensor

from torchmpm import checks, tree
from torchmpm.grid import PAD, Grid

#: Inclusive range of node indices; ``None`` at an end leaves it open.
Range = tuple[int | None, int | None]
Direction = Literal["+x", "-x", "+y", "-y"]
_DIRECTIONS: tuple[Direction, ...] = ("+x", "-x", "+y", "-y")


@dataclass(frozen=True)
class VelocityRule:
    """On a box of nodes, forbid one direction of motion.

    Where the velocity component points in the forbidden direction it becomes zero, and the tangential component is
    reduced by ``friction`` times the removed speed (Coulomb); ``friction=math.inf`` sticks: the whole velocity becomes
    zero. Motion the other way is free. Of several rules for one direction the first that covers a node counts.

    Attributes:
        direction: The component that is removed, ``"-y"`` for a floor.
        i: Inclusive range of node indices in x.
        j: Inclusive range of node indices in y.
        friction: Coulomb coefficient, 0 = frictionless, ``math.inf`` = sticky.
        frame: ``"world"``: the ranges count nodes from the world's origin, so an obstacle stays where it is while the
            window moves (by whole cells: the window's origin is truncated to nodes). ``"window"``: they count from the
            window's corner.

    Raises:
        ValueError: Unknown direction or frame, negative friction, or an empty range.
    """

    direction: Direction
    i: Range = (None, None)
    j: Range = (None, None)
    friction: float = 0.0
    frame: Literal["world", "window"] = "world"

    def __post_init__(self) -> None:
        if self.direction not in _DIRECTIONS:
            raise ValueError(f"direction must be one of {_DIRECTIONS}, got {self.direction!r}")
        if self.frame not in ("world", "window"):
            raise ValueError(f"frame must be 'world' or 'window', got {self.frame!r}")
        if self.friction != math.inf:
            checks.number("friction", self.friction, least=0.0)
        for name in ("i", "j"):
            object.__setattr__(self, name, _checked_range(name, getattr(self, name)))


def _checked_range(name: str, given: Any) -> Range:
    """A range of Python integers, or else a ValueError."""
    if isinstance(given, tuple | list) and len(given) == 2:
        ends = [end for end in given if end is not None]
        if all(isinstance(end, Integral) and not isinstance(end, bool) for end in ends) and ends == sorted(ends):
            low, high = (None if end is None else int(end) for end in given)
            return low, high
    raise ValueError(
        f"{name} must be an inclusive range (low, high) of node indices or None with low <= high, got {given!r}"
    )


def fixed(
    i: Range = (None, None), j: Range = (None, None), frame: Literal["world", "window"] = "world"
) -> tuple[VelocityRule, ...]:
    """Rules that hold the nodes of a box at rest.

    Args:
        i: Inclusive range of node indices in x.
        j: Inclusive range of node indices in y.
        frame: Origin of the ranges, see :class:`VelocityRule`.

    Raises:
        ValueError: A range is empty, or of other than whole numbers, or the frame is unknown.
    """
    return tuple(VelocityRule(direction, i, j, 0.0, frame) for direction in _DIRECTIONS)


@tree.register
@dataclass(frozen=True, eq=False)
class Face:
    """All rules against one direction, as masks over the padded grid for the current position of the window."""

    axis: int  # 0 for x, 1 for y
    sign: int  # +1 or -1, the sign of the removed component
    active: Tensor  # (1 or B, cells) nodes with a rule
    stick: Tensor | None  # (1 or B, cells) those of them that stick, if any
    friction: Tensor | None  # (1 or B, cells) Coulomb coefficients, if any


def limits(ends: Range) -> tuple[int | float, int | float]:
    """A range of nodes whose open ends are infinite."""
    low, high = ends
    return -math.inf if low is None else low, math.inf if high is None else high


def faces(rules: Sequence[VelocityRule], grid: Grid, origin: Tensor) -> tuple[Face, ...]:
    """The rules as masks for a window at origin (B, 2), m; it does not move during a step, so they serve all of it."""
    window = torch.arange(-PAD, grid.resolution + PAD, device=origin.device)[None]
    shift = grid.node_shift(origin)

    def covered(rule: VelocityRule) -> Tensor:
        inside = []
        for axis, ends in enumerate((rule.i, rule.j)):
            node = window + shift[:, axis : axis + 1] if ends != (None, None) and rule.frame == "world" else window
            first, last = limits(ends)
            inside.append((node >= first) & (node <= last))
        return (inside[0][:, :, None] & inside[1][:, None, :]).flatten(1)

    result = []
    for direction in dict.fromkeys(rule.direction for rule in rules):
        same = [rule for rule in rules if rule.direction == direction]
        active = torch.zeros(1, grid.width**2, dtype=torch.bool, device=origin.device)
        stick = friction = None
        for rule in same:
            new = covered(rule) & ~active
            active = active | new
            if math.isinf(rule.friction):
                stick = new if stick is None else stick | new
            elif rule.friction:
                before = torch.zeros_like(new, dtype=origin.dtype) if friction is None else friction
                friction = torch.where(new, rule.friction, before)
        axis, sign = "xy".index(direction[1]), 1 if direction[0] == "+" else -1
        result.append(Face(axis, sign, active, stick, friction))
    return tuple(result)


def constrain(faces: Sequence[Face], velocity: Tensor) -> Tensor:
    """Apply the rules to node velocities (2, B, cells), m/s.

    Rules of different directions commute unless one has a positive finite friction, so the order of directions only
    matters in a corner between two walls with friction.
    """
    component = list(velocity.unbind(0))
    for face in faces:
        normal, tangent = component[face.axis], component[1 - face.axis]
        hit = face.active & (normal > 0 if face.sign > 0 else normal < 0)
        if face.friction is not None:
            left = (tangent.abs() - face.friction * normal.abs()).clamp_min(0.0)
            slowed = torch.where(tangent < 0, -left, left)  # torch.copysign has no second derivative at 0
            tangent = torch.where(hit & (face.friction > 0), slowed, tangent)
        if face.stick is not None:
            tangent = torch.where(hit & face.stick, 0.0, tangent)
        component[face.axis], component[1 - face.axis] = torch.where(hit, 0.0, normal), tangent
    return torch.stack(component)
