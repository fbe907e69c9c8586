"""Obstacles: one list feeds physics (velocity rules), observation (drawn pixels) and picture (shown boxes)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dittogym.observation.image import RASTER
from torchmpm import VelocityRule, checks
from torchmpm.boundary import Range

#: Nodes per metre of every DittoGym window.
NODES = 128
#: Top of the floor in nodes; the surface lies between this node and the next.
FLOOR_NODE = 19
#: Half the width of the mark of a goal: ten fine pixels of the observation's raster, m.
MARK = 10 / RASTER


@dataclass(frozen=True)
class Box:
    """Axis-aligned box in the world, m; an infinite bound leaves a side open.

    Its bounds belong to it if it is ``closed``.
    """

    left: float = -math.inf
    right: float = math.inf
    bottom: float = -math.inf
    top: float = math.inf
    closed: bool = False

    @property
    def ground(self) -> bool:
        """Whether it is all that lies below some height."""
        return (self.left, self.right, self.bottom) == (-math.inf, math.inf, -math.inf) and self.top < math.inf


def nodes(left: float = -math.inf, right: float = math.inf, bottom: float = -math.inf, top: float = math.inf) -> Box:
    """A box whose bounds are counted in nodes from the world's origin."""
    return Box(left / NODES, right / NODES, bottom / NODES, top / NODES)


def mark(point: tuple[float, float]) -> Box:
    """What the observation shows of a goal: fine pixels less than ten away in both directions."""
    x, y = point
    return Box(x - MARK, x + MARK, y - MARK, y + MARK)


@dataclass(frozen=True)
class Obstacle:
    """Something that does not move.

    Attributes:
        name: For messages and docs.
        rules: What it does to matter; of several rules for one direction on a node the first in the task's list counts.
        drawn: What the robot sees of it: boxes whose pixels are set in the occupancy channel. Some obstacles of the
            reference implementation are invisible to the robot; they have none.
        shown: What a person sees of it in :meth:`dittogym.TorchEnv.render`.

    Raises:
        TypeError: A field is something else; a single rule or box needs its comma too, ``(rule,)``.
    """

    name: str
    rules: tuple[VelocityRule, ...]
    drawn: tuple[Box, ...] = ()
    shown: tuple[Box, ...] = ()

    def __post_init__(self) -> None:
        checks.instance("name", self.name, str)
        checks.instances("rules", self.rules, VelocityRule)
        for name in ("drawn", "shown"):
            checks.instances(name, getattr(self, name), Box)


def floor(friction: float = math.inf) -> Obstacle:
    """Ground up to node 19; sticky by default, as published (the reference's Coulomb branch never acts)."""
    surface = (FLOOR_NODE + 1) / NODES
    return Obstacle("floor", (VelocityRule("-y", j=(None, FLOOR_NODE), friction=friction),), shown=(Box(top=surface),))


def ceiling(node: int) -> Obstacle:
    """Upper end of the world: from this node on, nothing rises.

    Raises:
        ValueError: The node is not a whole number.
    """
    checks.whole("node", node, 0)
    return Obstacle("ceiling", (VelocityRule("+y", j=(node, None)),), shown=(Box(bottom=node / NODES),))


def side_walls(top: int | None) -> Obstacle:
    """Invisible walls at both ends of a fixed window that reaches from -0.5 m to 0.5 m, up to this node."""
    rules = (VelocityRule("+x", (32, 34), (None, top)), VelocityRule("-x", (-34, -32), (None, top)))
    height = math.inf if top is None else top
    return Obstacle("side walls", rules, shown=(nodes(32, 34, top=height), nodes(-34, -32, top=height)))


def solid(name: str, i: tuple[int, int], j: Range, *, visible: bool = True, friction: float = 0.0) -> Obstacle:
    """A box of nodes that matter cannot enter: one-sided faces left, right, below and above.

    Args:
        name: For messages and docs.
        i: Inclusive range of world node indices in x.
        j: Inclusive range of world node indices in y; ``None`` leaves an end open.
        visible: Whether the robot sees it.
        friction: Coulomb coefficient of its faces. Matter slips on them unless it is given; ``math.inf`` sticks, as the
            floor does.

    Raises:
        ValueError: A range is none, the friction is negative, or the box is narrower than four nodes, so that its faces
            would overlap.
    """
    for axis, given in (("i", i), ("j", j)):
        if not isinstance(given, tuple) or len(given) != 2 or not {type(end) for end in given} <= {int, type(None)}:
            raise ValueError(f"{axis} must be a range (low, high) of node indices, got {given!r}")
    if None in i:
        raise ValueError(f"i must have both ends, got {i!r}")
    (left, right), (low, high) = i, j
    if right - left < 3 or (low is not None and high is not None and high - low < 3):
        raise ValueError(f"solid needs at least 4 nodes in each direction, got i={i}, j={j}")
    rules = [
        VelocityRule("+x", (left, left + 1), j, friction=friction),
        VelocityRule("-x", (right - 1, right), j, friction=friction),
    ]
    if low is not None:
        rules.append(VelocityRule("+y", i, (low, low + 1), friction=friction))
    if high is not None:
        rules.append(VelocityRule("-y", i, (high - 1, high), friction=friction))
    box = nodes(left, right, -math.inf if low is None else low, math.inf if high is None else high)
    return Obstacle(name, tuple(rules), (box,) if visible else (), (box,))
