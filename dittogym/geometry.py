"""The world of a task: the simulated window of 1 m x 1 m, and obstacles, whose boxes feed physics and observation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf, isinf
from numbers import Real
from typing import TypeAlias

import torch
from torch import Tensor

from torchmpm import Grid, VelocityRule, checks
from torchmpm.boundary import Range, limits

#: Nodes per metre of every DittoGym window.
NODES = 128
#: The grid of every task.
GRID = Grid(NODES)
#: Centre (x, y), 0 to 1 m from the lower left corner of the window; ``None`` stands for the robot's centre.
Centre: TypeAlias = tuple[float | None, float | None]
#: Top of the floor in nodes; the surface lies between this node and the next.
FLOOR_NODE = 19


@dataclass(frozen=True)
class Window:
    """Where the simulated window, 1 m wide and high, lies in the world; its lower end is at y = 0.

    Attributes:
        left: The left end of a fixed window, m.
        follow: For a window that moves with the robot, the distance of the robot's centre from its left end, m;
            ``None`` for a fixed window.

    Raises:
        ValueError: Both are given, or one is not a number.
    """

    left: float = 0.0
    follow: float | None = None

    def __post_init__(self) -> None:
        checks.number("left", self.left)
        if self.follow is not None:
            checks.number("follow", self.follow)
            if self.left:
                raise ValueError(f"left must not be given with follow, got {self.left} and {self.follow}")

    @property
    def moves(self) -> bool:
        """Whether the window follows the robot."""
        return self.follow is not None

    def origin(self, com: Tensor) -> Tensor:
        """Lower left corner (B, 2) of the window for robots centred on ``com`` (B, 2), m."""
        left = torch.full_like(com[:, 0], self.left) if self.follow is None else com[:, 0] - self.follow
        return torch.stack((left, torch.zeros_like(left)), dim=1)


def contains(x: Tensor, origin: Tensor) -> Tensor:
    """Which of the points ``x`` (B, N, 2) lie in the windows at ``origin`` (B, 2): (B, N) bool; false for NaN."""
    height = x[..., 1] - origin[:, 1:2]
    return GRID.contains(x[..., 0], origin[:, 0:1]) & (height > 0) & (height < 1)


def centre_in_window(centre: Centre, robot: Tensor, origin: Tensor) -> Tensor:
    """A centre in window coordinates."""
    relative = robot - origin
    if centre == (None, None):
        return relative
    columns = [relative[:, i] if c is None else torch.full_like(relative[:, i], c) for i, c in enumerate(centre)]
    return torch.stack(columns, dim=1)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the world; an infinite bound leaves a side open.

    Attributes:
        left: Lower bound of x, m.
        right: Upper bound of x, m.
        bottom: Lower bound of y, m.
        top: Upper bound of y, m.
        closed: Whether the bounds belong to the box, which matters for pixels whose edge lies on a bound.

    Raises:
        ValueError: A bound is not a number, or bounds are not in order.
    """

    left: float = -inf
    right: float = inf
    bottom: float = -inf
    top: float = inf
    closed: bool = False

    def __post_init__(self) -> None:
        for low, high in (("left", "right"), ("bottom", "top")):
            ends = getattr(self, low), getattr(self, high)
            if not all(isinstance(end, Real) for end in ends) or not ends[0] <= ends[1]:
                raise ValueError(
                    f"{low} and {high} must be numbers with {low} <= {high}, got {ends[0]!r} and {ends[1]!r}"
                )


def nodes(left: float = -inf, right: float = inf, bottom: float = -inf, top: float = inf, closed: bool = False) -> Box:
    """A box whose bounds are counted in nodes from the world's origin."""
    return Box(left / NODES, right / NODES, bottom / NODES, top / NODES, closed)


@dataclass(frozen=True)
class Obstacle:
    """Something that does not move; :func:`solid`, :func:`floor` and others make common ones.

    Particles cannot enter its boxes, and the boxes are drawn in the observation and in
    :meth:`dittogym.TorchEnv.render`. ``rules`` replaces the effect on particles, and ``observed`` what the observation
    shows.

    Attributes:
        name: Its name in messages.
        boxes: Boxes whose edges lie on nodes, at multiples of 1/128 m, at least 4 nodes wide and high; any boxes if
            ``rules`` are given.
        friction: Coulomb coefficient of the faces of the boxes; ``math.inf`` is no slip, ``None`` stands for 0. It must
            not be given with ``rules``, which have coefficients of their own.
        rules: What it does to matter in place of what follows from the boxes, see :class:`torchmpm.VelocityRule`;
            ``()`` for nothing.
        observed: The boxes that the occupancy channel of the observation shows in place of ``boxes``; ``()`` makes it
            invisible.

    Raises:
        ValueError: A box is too small, or its edges are not on nodes; ``friction`` is negative, or given with
            ``rules``; or there are neither boxes nor rules nor observed boxes.
        TypeError: A value has another type.
    """

    name: str
    boxes: tuple[Box, ...] = ()
    friction: float | None = None
    rules: tuple[VelocityRule, ...] | None = None
    observed: tuple[Box, ...] | None = None

    def __post_init__(self) -> None:
        checks.instance("name", self.name, str)
        for name, kind in (("boxes", Box), ("rules", VelocityRule), ("observed", Box)):
            if (given := getattr(self, name)) is not None or name == "boxes":
                checks.instances(name, given, kind)
                object.__setattr__(self, name, tuple(given))  # later changes of the caller's do not reach it
        if self.rules is not None and self.friction is not None:
            raise ValueError(
                f"friction must not be given with rules, which have their own, got {self.friction} for {self.name!r}; "
                "Obstacle.with_friction changes that of all its faces"
            )
        _ = self.velocity_rules  # checks edges and friction
        if not (self.boxes or self.rules or self.observed):
            raise ValueError(f"boxes must not be empty without rules and observed, got none for {self.name!r}")

    @property
    def velocity_rules(self) -> tuple[VelocityRule, ...]:
        """The rules by which it acts on matter, ``rules`` or those that follow from the boxes."""
        if self.rules is not None:
            return self.rules
        return tuple(rule for box in self.boxes for rule in _faces(box, self.friction or 0.0))

    @property
    def observed_boxes(self) -> tuple[Box, ...]:
        """The boxes that the observation shows, ``observed`` or its own."""
        return self.boxes if self.observed is None else self.observed

    def with_friction(self, friction: float) -> Obstacle:
        """Return the same obstacle with another friction on all its faces, also on those of ``rules``.

        Args:
            friction: Coulomb coefficient; ``math.inf`` is no slip.
        """
        if self.rules is None:
            return replace(self, friction=friction)
        return replace(self, rules=tuple(replace(rule, friction=friction) for rule in self.rules))


def _faces(box: Box, friction: float) -> Iterator[VelocityRule]:
    """One-sided faces, two nodes deep, on the sides of a box that are not open."""
    edges = [edge * NODES for edge in (box.left, box.right, box.bottom, box.top)]
    if any(edge % 1 for edge in edges if not isinf(edge)):
        raise ValueError(f"boxes must have edges at multiples of 1/{NODES} m unless rules are given, got {box}")
    left, right, bottom, top = (None if isinf(edge) else round(edge) for edge in edges)
    i, j = (left, right), (bottom, top)
    for low, high in (i, j):
        if low is not None and high is not None and high - low < 3:
            raise ValueError(f"boxes must have at least 4 nodes in each direction unless rules are given, got {i}, {j}")
    if left is not None:
        yield VelocityRule("+x", (left, left + 1), j, friction=friction)
    if right is not None:
        yield VelocityRule("-x", (right - 1, right), j, friction=friction)
    if bottom is not None:
        yield VelocityRule("+y", i, (bottom, bottom + 1), friction=friction)
    if top is not None:
        yield VelocityRule("-y", i, (top - 1, top), friction=friction)


def floor(*, friction: float = inf) -> Obstacle:
    """Return the ground of DittoGym's tasks, up to node 19, which the observation does not show.

    It supports matter at about 0.156 m. For ground of another height use :func:`solid`.

    Args:
        friction: Coulomb coefficient; the default ``math.inf`` is no slip, as in the reference implementation.

    Raises:
        ValueError: ``friction`` is negative or not a number.
    """
    rule = VelocityRule("-y", j=(None, FLOOR_NODE), friction=friction)
    return Obstacle("floor", (nodes(top=FLOOR_NODE + 1),), rules=(rule,), observed=())


def ceiling(node: int) -> Obstacle:
    """Return the upper end of the world, from which on nothing rises, and which the observation does not show.

    Args:
        node: Index of the first node, counted upwards from the world's origin; node j is at j/128 m.

    Raises:
        ValueError: ``node`` is not a whole number from 0 on.
    """
    checks.whole("node", node, 0)
    return Obstacle("ceiling", (nodes(bottom=node),), rules=(VelocityRule("+y", j=(node, None)),), observed=())


def side_walls(top: int | None) -> Obstacle:
    """Return walls at x = -0.25 m and x = 0.25 m, as in GROW, DIG and CATCH, which the observation does not show.

    Args:
        top: Index of their last node, counted upwards from the world's origin; ``None`` for walls without an end.

    Raises:
        ValueError: ``top`` is not a whole number from 0 on.
    """
    if top is not None:
        checks.whole("top", top, 0)
    height = inf if top is None else top
    boxes = (nodes(32, 34, top=height), nodes(-34, -32, top=height))
    rules = (VelocityRule("+x", (32, 34), (None, top)), VelocityRule("-x", (-34, -32), (None, top)))
    return Obstacle("side walls", boxes, rules=rules, observed=())


def solid(name: str, i: Range, j: Range, *, visible: bool = True, friction: float = 0.0) -> Obstacle:
    """Return an obstacle in the form of a box that matter cannot enter.

    Args:
        name: Its name in messages.
        i: Range (first, last) of node indices in x, both included, counted from the world's origin; node i is at
            i/128 m, and ``None`` leaves an end open.
        j: The same in y, counted upwards.
        visible: Whether the observation shows it.
        friction: Coulomb coefficient of its faces; ``math.inf`` is no slip, as on the floor.

    Raises:
        ValueError: A range is not two node indices in order, the friction is negative, the box is narrower than four
            nodes, or ``visible`` is not True or False.

    Examples:
        >>> import dittogym
        >>> from dittogym.geometry import ceiling, floor, solid
        >>> step = solid("step", i=(40, 60), j=(None, 24), friction=0.5)
        >>> env = dittogym.TorchEnv("run", obstacles=(step, floor(friction=0.5), ceiling(119)), particles="lite")
    """
    checks.flag("visible", visible)
    inside = VelocityRule("+x", i, j)  # checks the ranges
    box = nodes(*limits(inside.i), *limits(inside.j))
    return Obstacle(name, (box,), friction, observed=None if visible else ())
