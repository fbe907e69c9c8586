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
    """A box of grid nodes in which one direction of motion is forbidden: a floor, a wall or the face of an obstacle.

    If the velocity of a node points in the forbidden direction, that component becomes zero, and the other component is
    reduced in magnitude by ``friction`` times the removed speed, at most to zero (Coulomb friction). Motion in the
    opposite direction stays free. If several rules of a solver forbid one direction at a node, the first one applies.

    Attributes:
        direction: The direction that is forbidden, such as ``"-y"`` for a floor.
        i: Range (first, last) of node indices in x, both included; ``None`` leaves an end open.
        j: The same in y.
        friction: Coulomb coefficient: 0 is frictionless, and with ``math.inf`` the whole velocity becomes zero.
        frame: With ``"world"`` the indices count from the world's origin, so that an obstacle stays where it is while
            the window moves; the window's origin is truncated to whole nodes for this. With ``"window"`` they count
            from the window's lower left corner.

    Raises:
        ValueError: ``direction`` or ``frame`` is unknown, ``friction`` is negative or not a number, or a range is empty
            or does not consist of whole numbers.

    Examples:
        Ground up to node 10, which supports matter at about 11 h:

        >>> import torchmpm
        >>> ground = torchmpm.VelocityRule("-y", j=(None, 10), friction=0.5)
        >>> body = torchmpm.Body(100, torchmpm.Elastic(1e3, 1e3))
        >>> solver = torchmpm.Solver(torchmpm.Grid(64), (body,), rules=(ground,))
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
        f"{name} must be an inclusive range (low, high) of node indices, whole numbers or None, with low <= high, "
        f"got {given!r}"
    )


def fixed(
    i: Range = (None, None), j: Range = (None, None), frame: Literal["world", "window"] = "world"
) -> tuple[VelocityRule, ...]:
    """Return the rules that hold the nodes of a box at rest, one for each direction.

    Args:
        i: Range (first, last) of node indices in x, both included; ``None`` leaves an end open.
        j: The same in y.
        frame: What the indices count from, see :class:`torchmpm.VelocityRule`.

    Returns:
        Four frictionless rules, for the ``rules`` of a :class:`torchmpm.Solver`.

    Raises:
        ValueError: A range is empty or does not consist of whole numbers, or ``frame`` is unknown.
    """
    return tuple(VelocityRule(direction, i, j, 0.0, frame) for direction in _DIRECTIONS)


@tree.register
@dataclass(frozen=True, eq=False)
class Face:
    """All rules of a solver against one direction, as masks over the nodes for the present position of the window.

    The nodes are those of :meth:`torchmpm.Grid.nodes`, in that order. Masks have a leading 1 instead of B where they
    are the same in all simulations.

    Attributes:
        axis: 0 for x, 1 for y.
        sign: Sign of the removed component, +1 or -1.
        active: (1 or B, cells) bool, nodes with a rule.
        stick: (1 or B, cells) bool, nodes with infinite friction; ``None`` if there are none.
        friction: (1 or B, cells) Coulomb coefficients, 0 where there is no friction; ``None`` if all are 0 or infinite.
    """

    axis: int
    sign: int
    active: Tensor
    stick: Tensor | None
    friction: Tensor | None


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
