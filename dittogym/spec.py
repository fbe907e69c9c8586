"""A task as data: what is in the world, how it is seen and driven, and what is rewarded."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from dittogym.bodies.shapes import Shape
from dittogym.geometry import NODES, Box, Centre, Obstacle, Window
from dittogym.observation import SIZE, goal_box
from dittogym.rewards import Reward, TaskState, Transition
from torchmpm import Body, Material, checks

#: Duration of a control step, s.
CONTROL_STEP = 1e-2
#: Duration of a substep in the reference implementation, s, which damping is given for.
DT = 1e-4


@dataclass(frozen=True)
class BodySpec:
    """A body of a task: the robot or an object.

    Attributes:
        shape: Where its particles start, one of :mod:`dittogym.bodies.shapes`.
        count: Number of particles with ``particles="full"``.
        mass: Mass of a particle with ``particles="full"``, kg. With other numbers of particles the mass of the body
            stays the same. Each particle of full size has the undeformed volume 1 m^2.
        material: Its material, a :class:`torchmpm.Material`; ``None`` for one with the constants of the task, a
            :class:`torchmpm.VonMises` for the robot and a :class:`torchmpm.Elastic` for an object.
        lite: Number of particles with ``particles="lite"``; ``None`` stands for 2,000, or ``count`` if that is less,
            for the robot, and for a number in proportion for an object.
        hidden_velocity: Whether the velocity channels of the observation leave the body out.

    Raises:
        ValueError: A number is out of range, or ``hidden_velocity`` is not True or False.
        TypeError: ``shape`` is not a :class:`dittogym.bodies.shapes.Shape`, or ``material`` not a
            :class:`torchmpm.Material`.
    """

    shape: Shape
    count: int
    mass: float = 2.0
    material: Material | None = None
    lite: int | None = None
    hidden_velocity: bool = False

    def __post_init__(self) -> None:
        checks.instance("shape", self.shape, Shape)
        object.__setattr__(self, "count", checks.whole("count", self.count, 1))
        checks.number("mass", self.mass, above=0.0)
        if self.lite is not None:
            object.__setattr__(self, "lite", checks.whole("lite", self.lite, 1))
        if self.material is not None:
            Body(1, self.material)  # checks it
        checks.flag("hidden_velocity", self.hidden_velocity)


def no_task_state(transition: Transition, spec: TaskSpec) -> TaskState:
    """The state of a task that remembers nothing."""
    return {}


@dataclass(frozen=True)
class TaskSpec:
    """A task as data: what is in the world, how it is seen and driven, and what is rewarded.

    ``dataclasses.replace`` derives a task from another one, such as :func:`dittogym.make_spec` returns.

    Attributes:
        name: Name of the task, part of the ids ``dittogym/{name}-coarse-v0`` and ``dittogym/{name}-fine-v0``.
        horizon: Control steps of an episode.
        robot: The robot.
        mu: Second Lame parameter of the robot, and of an object without a material of its own, Pa; positive.
        yield_stress: Yield stress of the robot, Pa; not negative.
        max_actuation: Muscle stress at action 1, Pa; not negative.
        reward_fn: A function that takes a :class:`dittogym.Transition` and this specification, and returns a
            :class:`dittogym.Reward`. With the operations of ``transition.ops`` the reward has a smooth form, too.
        weights: Weights of the reward terms of ``reward_fn`` by name, and of any terms of the environment: ``split``, a
            penalty for a torn robot where there is a ``split_limit``, see
            :meth:`dittogym.rewards.RewardOps.split_penalty`; ``action``, minus the sum over both muscle directions of
            the Frobenius norm of the actuation on the patch, Pa; and ``alive``, 1 in every step.
        objects: Bodies besides the robot, at most one.
        lam: First Lame parameter of the robot, and of an object without a material of its own, Pa.
        gravity: Acceleration (x, y), m/s^2.
        damping: Factor on node velocities in every 1e-4 s; 1 is no damping.
        window: Where the simulated window lies, and whether it follows the robot.
        view: Centre (x, y) of the observed region, which is half a metre wide, relative to the lower left corner of the
            window, m, from 0 to 1; ``None`` for a coordinate that follows the robot.
        patch_centre: Centre (x, y) of the action patch, in the same form.
        patch: P, width of the action patch in nodes, from 4 to 128.
        obstacles: Static geometry; of several obstacles that forbid one direction of motion at a node, the first
            counts.
        goal: Point (x, y) in the world, m, drawn in the observation as a square 2 cm wide; ``None`` for no goal.
        coarse: R of the resolution ``"coarse"``, at most ``fine``.
        fine: R of the resolution ``"fine"``, at most ``patch``.
        split_limit: Radius of gyration above which the robot counts as torn and the episode ends, m; ``None`` for no
            limit.
        initial_task_state: A function that takes a :class:`dittogym.Transition` and this specification right after a
            reset, and returns what the task is to remember, tensors by name with a leading B.
        target: (64, 64) bool picture to match, centred on the robot, row 0 at the top, which pictures of the task show;
            ``None`` for none.

    Raises:
        ValueError: A number is out of range, there is more than one object, or ``target`` is another kind of array.
        TypeError: A value has another type, or a function cannot be called.
    """

    name: str
    horizon: int
    robot: BodySpec
    mu: float
    yield_stress: float
    max_actuation: float
    reward_fn: RewardFunction
    weights: Mapping[str, float]
    objects: tuple[BodySpec, ...] = ()
    lam: float = 50.0
    gravity: tuple[float, float] = (0.0, 0.0)
    damping: float = 1.0
    window: Window = Window()  # noqa: RUF009
    view: Centre = (None, None)
    patch_centre: Centre = (None, None)
    patch: int = 64
    obstacles: tuple[Obstacle, ...] = ()
    goal: tuple[float, float] | None = None
    coarse: int = 8
    fine: int = 16
    split_limit: float | None = None
    initial_task_state: TaskStateFunction = no_task_state
    target: np.ndarray | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for name, kind in (("name", str), ("robot", BodySpec), ("window", Window), ("weights", Mapping)):
            checks.instance(name, getattr(self, name), kind)
        for name, each in (("objects", BodySpec), ("obstacles", Obstacle)):
            checks.instances(name, given := getattr(self, name), each)
            object.__setattr__(self, name, tuple(given))  # later changes of the caller's do not reach it
        self._check_numbers()
        object.__setattr__(self, "weights", dict(self.weights))
        if len(self.objects) > 1:
            raise ValueError(f"objects must be at most one body, got {len(self.objects)}")
        if self.target is not None:
            checks.instance("target", self.target, np.ndarray)
            if self.target.dtype != bool or self.target.shape != (SIZE, SIZE):
                found = f"{self.target.dtype} of shape {self.target.shape}"
                raise ValueError(f"target must be bool of shape {(SIZE, SIZE)}, got {found}")
        for name in ("reward_fn", "initial_task_state"):
            if not callable(given := getattr(self, name)):
                raise TypeError(f"{name} must be a function of a Transition and a TaskSpec, got {given!r}")

    def __repr__(self) -> str:
        """What tells tasks apart at a glance; `dataclasses.asdict` shows all fields."""
        sizes = f"horizon={self.horizon}, coarse={self.coarse}, fine={self.fine}"
        return f"{type(self).__name__}({self.name!r}, {sizes}, terms={[*self.weights]})"

    def _check_numbers(self) -> None:
        for name, value in self.weights.items():
            # Tearing and actions are costs, whose terms are negative.
            checks.number(f"weights[{name!r}]", value, least=0.0 if name in ("split", "action") else None)
        checks.number("mu", self.mu, above=0.0)
        checks.number("lam", self.lam)
        for name in ("yield_stress", "max_actuation"):
            checks.number(name, getattr(self, name), least=0.0)
        checks.number("damping", self.damping, least=0.0, most=1.0)
        if self.split_limit is not None:
            checks.number("split_limit", self.split_limit, above=0.0)
        object.__setattr__(self, "patch", checks.whole("patch", self.patch, 4, NODES))
        for name, most in (("horizon", None), ("coarse", self.patch), ("fine", self.patch)):
            object.__setattr__(self, name, checks.whole(name, getattr(self, name), 1, most))
        if self.coarse > self.fine:
            raise ValueError(f"coarse must be at most fine, {self.fine}, got {self.coarse}")
        for name in ("gravity", "goal"):
            if (given := getattr(self, name)) is not None or name == "gravity":
                checks.pair(name, given)
                object.__setattr__(self, name, tuple(map(float, given)))
        for name in ("view", "patch_centre"):
            centre: Centre = getattr(self, name)
            if not isinstance(centre, tuple | list):
                raise TypeError(f"{name} must be two numbers, or None for each that follows the robot, got {centre!r}")
            checks.pair(name, tuple(0.0 if c is None else c for c in centre))  # None follows the robot
            if not all(c is None or 0 <= c <= 1 for c in centre):
                raise ValueError(f"{name} must be 0 to 1 m from the lower left corner of the window, got {centre!r}")
            object.__setattr__(self, name, tuple(centre))

    @property
    def bodies(self) -> tuple[BodySpec, ...]:
        """The robot and the objects, in the order of their particles."""
        return (self.robot, *self.objects)

    @property
    def starts_alike(self) -> bool:
        """Whether particles start in the same places with every seed, as in GROW and OBSTACLE."""
        return not any(body.shape.draws for body in self.bodies)

    @property
    def observed_boxes(self) -> tuple[Box, ...]:
        """What the robot sees of obstacles and goal."""
        boxes = tuple(box for obstacle in self.obstacles for box in obstacle.observed_boxes)
        return boxes if self.goal is None else (*boxes, goal_box(self.goal))


RewardFunction: TypeAlias = Callable[[Transition, TaskSpec], Reward]
TaskStateFunction: TypeAlias = Callable[[Transition, TaskSpec], TaskState]
