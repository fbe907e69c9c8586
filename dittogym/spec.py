"""A task as data: what is in the world, how it is seen and driven, and what is rewarded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from torch import Tensor

from dittogym.bodies.shapes import Shape
from dittogym.geometry import NODES, Box, Obstacle, mark
from dittogym.observation.raster import SIZE
from torchmpm import Material, ParticleState, checks

#: Rewards per step of an element whose state is no longer finite; its episode ends.
FAILURE_REWARD = -16.0


@dataclass(frozen=True)
class Body:
    """Particles of one kind.

    Attributes:
        shape: Where they start.
        count: Particles at full size.
        mass: Mass of a particle at full size, kg.
        material: Of an object; ``None``: elastic, with the robot's Lame parameters. The robot always is von Mises
            matter with the constants of its task.
        lite: Particles in the lite tier; ``None``: in proportion to the robot's.
        moves_visibly: Whether the velocity channels of the observation show it; the occupancy channel always does.
    """

    shape: Shape
    count: int
    mass: float = 2.0
    material: Material | None = None
    lite: int | None = None
    moves_visibly: bool = True

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: There are no particles, or they weigh nothing.
            TypeError: The shape is none.
        """
        checks.instance("shape", self.shape, Shape)
        checks.whole("count", self.count, 1)
        checks.number("mass", self.mass, above=0.0)


class Measurement(NamedTuple):
    """Averages over bodies at one moment.

    Attributes:
        com: (B, 2) mean position of the robot's particles in the world, m.
        velocity: (B, 2) mean velocity of the robot's particles, m/s.
        split: (B,) spread of the robot, sqrt(Var x + Var y), m.
        object_com: (B, 2) the same for the object; ``None`` in tasks without one.
        object_velocity: (B, 2), m/s.
    """

    com: Tensor
    velocity: Tensor
    split: Tensor
    object_com: Tensor | None = None
    object_velocity: Tensor | None = None


class Moment(NamedTuple):
    """What a task's own terms may look at after a step.

    Attributes:
        particles: The state.
        robot: Number of robot particles; they come first.
        now: Averages after the step.
        start: Averages right after the reset.
        observation: (B, 3, 64, 64) uint8; floating point if ``soft``, from
            :func:`dittogym.observation.smooth.soft_observation`.
        memory: What the task remembers, tensors with a leading B.
        soft: Whether smooth terms are wanted, for gradients; then nothing but the terms is used of the outcome.
    """

    particles: ParticleState
    robot: int
    now: Measurement
    start: Measurement
    observation: Tensor
    memory: Mapping[str, Tensor]
    soft: bool = False


class Outcome(NamedTuple):
    """A task's own judgement of a step.

    Attributes:
        terms: Named reward terms, (B,) each, already weighted; not ``split``, ``action``, ``alive`` or ``failure``,
            which the engine adds.
        terminated: (B,) bool, the task's own reasons to end; ``None`` for none.
        success: (B,) bool; ``None`` where success is not defined.
        info: Further quantities for ``info``, leading B.
        memory: Replaces the memory, leading B; ``None`` keeps it.
    """

    terms: Mapping[str, Tensor]
    terminated: Tensor | None = None
    success: Tensor | None = None
    info: Mapping[str, Tensor] = {}
    memory: Mapping[str, Tensor] | None = None


@dataclass(frozen=True)
class Weights:
    """Weights of the reward terms.

    Attributes:
        location: Of the task's own terms of place.
        velocity: Of its terms of speed.
        split: Of the term of a torn robot, which all tasks share where they have a limit of the spread.
        action: Of the size of the actuation field.
        alive: Reward of every step.
    """

    location: float = 0.0
    velocity: float = 0.0
    split: float = 0.0
    action: float = 0.0
    alive: float = 0.0

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: One is none, or not finite.
        """
        for name, value in vars(self).items():
            checks.number(name, value)


@dataclass(frozen=True)
class Window:
    """Where the 1 m x 1 m simulated window lies in the world.

    Attributes:
        left: Its left end for a fixed window, m.
        follow: For a moving window the distance of the robot's centre from its left end, m; then ``left`` is unused.
    """

    left: float = 0.0
    follow: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: One is not finite.
        """
        checks.number("left", self.left)
        if self.follow is not None:
            checks.number("follow", self.follow)


#: Centre (x, y) in window coordinates, m; ``None`` stands for the robot's centre.
Centre = tuple[float | None, float | None]


def nothing(moment: Moment) -> Mapping[str, Tensor]:
    """The memory of a task that needs none."""
    return {}


@dataclass(frozen=True)
class TaskSpec:
    """Everything that makes a task.

    Attributes:
        name: Part of the environment id.
        horizon: Control steps of an episode.
        robot: The robot.
        mu: Second Lame parameter of robot and elastic object, Pa.
        lam: First Lame parameter, Pa.
        yield_stress: Of the robot, Pa.
        max_actuation: Muscle stress at action 1, Pa.
        judge: The task's own reward terms, termination and success. Asked for soft terms it should return smooth ones,
            see :class:`Moment` and the helpers in :mod:`dittogym.rewards`; a smooth reward needs nothing.
        weights: Weights of the terms that all tasks share, and of the task's own.
        objects: Bodies beside the robot, at most one.
        gravity: (x, y), m/s^2.
        damping: Factor on node velocities in every substep.
        window: Fixed or moving window.
        view: Centre of the observed half-window.
        reach: Centre of the patch of nodes on which actions act.
        patch: Its width in nodes.
        obstacles: Static geometry, in order of precedence.
        goal: Point in the world that the observation marks by a square of 19 fine pixels, m; ``None`` for none.
        coarse, fine: Action resolutions.
        split_limit: Spread at which the episode ends, m; ``None`` for never.
        remember: What to keep from the start of an episode, tensors with a leading B.
        stale: Entries of the memory that a reset leaves as they are under ``parity="reference"``.
        target: (64, 64) bool picture to match, centred on the robot, row 0 at the top; for pictures of the task.

    Raises:
        ValueError: A number is out of range, or there is more than one object.
        TypeError: A body, an obstacle or a group of numbers is something else, or ``judge`` or ``remember`` cannot be
            called.
    """

    name: str
    horizon: int
    robot: Body
    mu: float
    yield_stress: float
    max_actuation: float
    judge: Callable[[Moment, Weights], Outcome]
    weights: Weights
    objects: tuple[Body, ...] = ()
    lam: float = 50.0
    gravity: tuple[float, float] = (0.0, 0.0)
    damping: float = 1.0
    window: Window = Window()
    view: Centre = (None, None)
    reach: Centre = (None, None)
    patch: int = 64
    obstacles: tuple[Obstacle, ...] = ()
    goal: tuple[float, float] | None = None
    coarse: int = 8
    fine: int = 16
    split_limit: float | None = None
    remember: Callable[[Moment], Mapping[str, Tensor]] = nothing
    stale: tuple[str, ...] = ()
    target: np.ndarray | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        """Check what would otherwise fail late or silently."""
        checks.instance("name", self.name, str)
        checks.whole("horizon", self.horizon, 1)
        checks.number("mu", self.mu, above=0.0)
        for name in ("yield_stress", "max_actuation", "damping"):
            checks.number(name, getattr(self, name), least=0.0)
        checks.number("lam", self.lam)
        if self.split_limit is not None:
            checks.number("split_limit", self.split_limit, above=0.0)
        for name in ("gravity", "goal", "view", "reach"):
            self._check_point(name, optional=name == "goal", open_ended=name in ("view", "reach"))
        checks.instance("weights", self.weights, Weights)
        checks.instance("window", self.window, Window)
        checks.instances("obstacles", self.obstacles, Obstacle)
        if self.target is not None and np.shape(self.target) != (SIZE, SIZE):
            raise ValueError(f"target must have shape {(SIZE, SIZE)}, got {np.shape(self.target)}")
        checks.whole("patch", self.patch, 4, NODES)
        for name in ("coarse", "fine"):
            checks.whole(name, getattr(self, name), 1, self.patch)
        checks.instance("robot", self.robot, Body)
        for name in ("material", "lite"):
            if (given := getattr(self.robot, name)) is not None:
                raise ValueError(f"robot.{name} must be None, it follows from the task, got {given!r}")
        checks.instances("objects", self.objects, Body)
        if len(self.objects) > 1:
            raise ValueError(f"objects must be at most one body, got {len(self.objects)}")
        if not callable(self.judge):
            raise TypeError(f"judge must be a function from Moment and Weights to Outcome, got {self.judge!r}")
        if not callable(self.remember):
            raise TypeError(f"remember must be a function from Moment to tensors by name, got {self.remember!r}")
        checks.instances("stale", self.stale, str)

    def _check_point(self, name: str, *, optional: bool, open_ended: bool) -> None:
        given = getattr(self, name)
        if given is None and optional:
            return
        if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != 2:
            raise ValueError(f"{name} must be two numbers (x, y), got {given!r}")
        for axis, value in zip("xy", given, strict=True):
            if value is not None or not open_ended:
                checks.number(f"{name} {axis}", value)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Robot and objects in particle order."""
        return (self.robot, *self.objects)

    @property
    def drawn(self) -> tuple[Box, ...]:
        """What the robot sees of obstacles and goal."""
        boxes = tuple(box for obstacle in self.obstacles for box in obstacle.drawn)
        return boxes if self.goal is None else (*boxes, mark(self.goal))
