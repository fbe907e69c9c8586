"""An environment as pure functions: :func:`reset` and :func:`step` of a :class:`Model` and an :class:`EnvState`.

They keep nothing, so that they work under ``torch.func`` and in checkpoints, where :class:`dittogym.TorchEnv` does not.
``env.model`` and ``env.env_state`` of a :class:`dittogym.TorchEnv` are a model and a state.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dittogym.action import patch_field, place
from dittogym.conditions import Drawn
from dittogym.copies import constant
from dittogym.geometry import GRID, centre_in_window, contains
from dittogym.observation import Camera
from dittogym.physics import NAMES, Physics, bodies_of
from dittogym.rewards import EXACT, SMOOTH, Features, Reward, RewardOps, TaskState, Transition, action_cost, features_of
from dittogym.spec import DT, TaskSpec
from torchmpm import ParticleState, Solver, checks, tree
from torchmpm.checks import Segment
from torchmpm.stability import check_gravity, stable_dt
from torchmpm.tree import cached_tensors

#: Reward of a step after which a simulation cannot go on, see :func:`is_valid`; its episode ends.
FAILURE_REWARD = -16.0
#: Distance from the window, m, that particles reach only in a simulation that has blown up.
FAR = 100.0
#: Terms that the environment adds to those of a task.
RESERVED_TERMS = frozenset({"split", "action", "alive", "failure"})
#: What the environment puts into ``info``, and what Gymnasium does.
RESERVED_INFO = frozenset({"com", "split", "finite", "object_com", "reward_terms", "is_success", "true_reward"})
RESERVED_INFO |= {"episode", "final_obs", "final_info"}


@tree.register
@dataclass(frozen=True, eq=False)
class EnvState:
    """The complete state of B episodes, a pytree (see :mod:`torchmpm.tree`) of tensors with a leading B.

    Attributes:
        particles: The state of all particles, robot first.
        origin: (B, 2) lower left corner of the window in the world, m.
        centre: (B, 2) the robot's centre in the world, on which the next action is placed, m.
        start: Averages right after the reset.
        task_state: What the task remembers, tensors by name with a leading B.
        physics: Constants that differ from the task's, see :func:`dittogym.physics.physics_values`.
        steps: (B,) int64, control steps since the reset.
        conditions: The conditions of these episodes, tensors by name with a leading B, see
            :class:`dittogym.Conditions`; empty without conditions. The functions of this module pass them on without
            effect: only :class:`dittogym.TorchEnv` disturbs actions and observations.
    """

    particles: ParticleState
    origin: Tensor
    centre: Tensor
    start: Features
    task_state: TaskState
    physics: Physics
    steps: Tensor
    conditions: Drawn = field(default_factory=dict)

    def __repr__(self) -> str:
        """Particles in short, and the fewest and the most steps of the batch; the numbers would fill pages."""
        low, high = f"{self.steps.min()}", f"{self.steps.max()}"
        return f"{type(self).__name__}({self.particles!r}, steps={low if low == high else f'{low} to {high}'})"

    def __getstate__(self) -> dict[str, Any]:
        """The fields, for pickles and deep copies, which cannot hold an autograd graph."""
        tree.refuse_graph("the state of a TorchEnv", self)
        return vars(self)


@dataclass(frozen=True, eq=False)
class Model:
    """A task with a certain number of particles and length of substeps, without state; :func:`make_model` makes one.

    Attributes:
        spec: The task.
        solver: The solver of its physics.
        substeps: Substeps in a control step.
        camera: What draws the observations, for :func:`observe` and :func:`soft_observation`.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
    """

    spec: TaskSpec
    solver: Solver
    substeps: int
    camera: Camera
    segment: Segment = "auto"

    @functools.cached_property
    def num_robot_particles(self) -> int:
        """Number of the robot's particles, which come first."""
        return self.counts[0]

    @functools.cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of particles of each body, robot first."""
        return tuple(body.count for body in self.solver.bodies)

    @functools.cached_property
    def full_size(self) -> bool:
        """Whether there are as many particles as with ``particles="full"``."""
        return self.counts == tuple(body.count for body in self.spec.bodies)

    def solver_for(self, physics: Physics) -> Solver:
        """Return the solver with other constants of the matter.

        Args:
            physics: Constants in place of the task's own, as :func:`dittogym.physics.physics_values` returns them.
        """
        if not physics:
            return self.solver
        bodies = bodies_of(self.spec, self.counts, physics)
        return self.solver.with_constants(bodies, physics.get("gravity", self.spec.gravity))


def make_model(
    spec: TaskSpec, counts: tuple[int, ...], substeps: int, backend: str, segment: Segment = "auto", dt: float = DT
) -> Model:
    """Make the model of a task.

    Args:
        spec: The task.
        counts: Number of particles of each body, robot first.
        substeps: Substeps in a control step.
        backend: Backend of the solver, see :class:`torchmpm.Solver`.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
        dt: Duration of a substep, s.

    Raises:
        ValueError: A number is out of range, ``backend`` is unknown or not available, there are other numbers of
            ``counts`` than bodies, or the matter, its muscles or gravity need shorter substeps.
    """
    full = tuple(body.count for body in spec.bodies)
    if len(counts) != len(full):
        raise ValueError(f"counts must be {len(full)} numbers, one for each body, got {counts!r}")
    counts = tuple(checks.whole(f"counts[{i}]", n, 1) for i, n in enumerate(counts))
    substeps, segment = checks.whole("substeps", substeps, 1), checks.segment(segment)
    checks.number("dt", dt, above=0.0)
    solver = Solver(
        GRID,
        bodies_of(spec, counts, {}),
        gravity=spec.gravity,
        damping=spec.damping ** (dt / DT),
        rules=tuple(rule for obstacle in spec.obstacles for rule in obstacle.velocity_rules),
        dt=dt,
        backend=backend,
        allow_unstable=True,  # checked with the muscles, here and when a reset changes the matter
    )
    native = backend in ("auto", "native")  # of the camera, which draws any matter
    camera = Camera(
        spec.view,
        spec.window,
        spec.observed_boxes,
        counts=counts,
        particle_weight=tuple(n / m for n, m in zip(full, counts, strict=True)),
        hidden_velocity=tuple(body.hidden_velocity for body in spec.bodies),
        pixels=counts == full,
        native=native,
    )
    model = Model(spec, solver, substeps, camera, segment)
    check_stability(model, {})
    return model


def check_stability(model: Model, physics: Physics) -> None:
    """Refuse matter that with its muscles needs shorter substeps, and gravity that does."""
    solver = model.solver_for(physics)
    actuation = physics.get("max_actuation", model.spec.max_actuation)
    limit = solver.stable_dt(actuation)
    if solver.dt > limit:
        robot = stable_dt(solver.bodies[:1], GRID.h, actuation) == limit
        matter = f"the material, muscles and mass of the {'robot' if robot else 'object'}"
        raise ValueError(f"dt must be at most {limit} s to be stable with {matter}, got {solver.dt}")
    name = "physics['gravity']" if "gravity" in physics else "gravity"
    check_gravity(name, solver.gravity, GRID.h, solver.dt)


class StepResult(NamedTuple):
    """The result of a control step.

    Attributes:
        state: The next state.
        observation: (B, 3, 64, 64) uint8.
        reward: (B,), the sum of the terms; smooth if that was asked for.
        terms: Weighted reward terms by name, (B,) each.
        terminated: (B,) bool, whether the task ended the episode, or the simulation cannot go on.
        success: (B,) bool, whether the task is solved now; ``None`` where the task does not define success.
        info: Tensors by name with a leading B: ``com``, ``split``, ``finite``, ``object_com`` in tasks with an object,
            see :meth:`dittogym.TorchEnv.step`, and the task's own quantities.
        true_reward: (B,), the exact reward of the task.
        actuation: (B, 2, P, P) muscle stress on the nodes of the action patch, Pa.
        soft_observation: (B, 3, 64, 64), see :func:`soft_observation`; ``None`` unless the reward is smooth.
    """

    state: EnvState
    observation: Tensor
    reward: Tensor
    terms: Mapping[str, Tensor]
    terminated: Tensor
    success: Tensor | None
    info: Mapping[str, Tensor]
    true_reward: Tensor
    actuation: Tensor
    soft_observation: Tensor | None = None


def reset(
    model: Model, positions: Tensor, physics: Physics | None = None, velocity: Tensor | None = None
) -> tuple[EnvState, Tensor]:
    """Start episodes at given positions.

    Args:
        model: The task.
        positions: (B, N, 2) positions of the particles in the world, m, robot first.
        physics: Constants in place of the task's own, as :func:`dittogym.physics.physics_values` returns them; ``None``
            for the task's own. Whether the matter is stable with them is not checked.
        velocity: (B, 2) velocity of all of the robot, m/s; ``None`` for rest.

    Returns:
        The state, and the observation (B, 3, 64, 64) uint8.

    Raises:
        ValueError: ``positions`` has another shape or dtype, ``physics`` holds an unknown name, or the task's
            ``initial_task_state`` returns tensors without a leading B.
        TypeError: The task's ``initial_task_state`` returns no mapping.

    Examples:
        >>> import dittogym, torch
        >>> from dittogym import core
        >>> env = dittogym.TorchEnv("run", particles=300, substeps=10)
        >>> observation, info = env.reset(seed=0)
        >>> state, observation = core.reset(env.model, env.state.x)
        >>> result = core.step(env.model, state, torch.zeros(1, 2, 8, 8))
        >>> result.reward.shape
        torch.Size([1])
    """
    shape = model.solver.num_particles, 2
    if not isinstance(positions, Tensor) or positions.ndim != 3 or positions.shape[1:] != shape:
        raise ValueError(f"positions must be a tensor of shape (B, {shape[0]}, 2), got {_kind(positions)}")
    if unknown := [name for name in physics or () if name not in NAMES]:
        raise ValueError(f"physics may hold {', '.join(NAMES)}, got {', '.join(unknown)}")
    spec, particles = model.spec, ParticleState.at_rest(positions)
    if velocity is not None:
        moving = torch.arange(shape[0], device=positions.device) < model.num_robot_particles
        particles = replace(particles, v=moving[:, None] * velocity[:, None])
    start = features_of(particles, model.num_robot_particles)
    steps = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    state = EnvState(particles, spec.window.origin(start.com), start.com, start, {}, physics or {}, steps)
    observation = observe(model, state)
    task_state = spec.initial_task_state(_transition(model, state, start, observation, EXACT), spec)
    who = f"initial_task_state of task {spec.name!r}"
    if not isinstance(task_state, Mapping):
        raise TypeError(f"{who} must return tensors by name, got {_kind(task_state)}")
    _check_leading(who, "tensors", task_state, len(positions))
    # Of any kind of mapping, and a copy: it may hold what the state does.
    return replace(state, task_state=tree.map(Tensor.clone, dict(task_state))), observation


def step(model: Model, state: EnvState, action: Tensor, *, soft: bool = False) -> StepResult:
    """Advance by one control step.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in the layout ``"grid"``, see :func:`dittogym.action.to_grid_layout`, from -1 to 1, with
            the dtype of the state; R is at most the task's patch. A simulation with numbers that are not finite ends
            with the reward :data:`FAILURE_REWARD`.
        soft: Whether the reward is the smooth one, for gradients, and there is a smooth observation; everything else is
            the same.

    Raises:
        ValueError: ``action`` has another shape or dtype.
    """
    x, shape = state.particles.x, action.shape if isinstance(action, Tensor) else ()
    square = len(shape) == 4 and shape[2] == shape[3] <= model.spec.patch
    if not square or shape[:2] != (len(x), 2) or action.dtype != x.dtype:
        allowed = f"{x.dtype} of shape ({len(x)}, 2, R, R) with R at most {model.spec.patch}"
        raise ValueError(f"action must be {allowed}, got {_kind(action)}")
    return judge(model, simulate(model, state, action), soft=soft)


class Moment(NamedTuple):
    """What a control step comes to before it is rewarded: all that does not depend on a task's own functions.

    Attributes:
        state: After the step, with the task state from before it.
        actuation: (B, 2, P, P) on the patch, Pa.
        observation: (B, 3, 64, 64) uint8.
        now: Averages after the step.
        info: See :func:`info_of`.
        cost: (B,) :func:`dittogym.rewards.action_cost`; ``None`` where it has no weight.
    """

    state: EnvState
    actuation: Tensor
    observation: Tensor
    now: Features
    info: dict[str, Tensor]
    cost: Tensor | None


def simulate(model: Model, state: EnvState, action: Tensor) -> Moment:
    """Advance the physics by one control step and look at the result; arguments as in :func:`advance`."""
    return look(model, *advance(model, state, action))


def look(model: Model, state: EnvState, actuation: Tensor) -> Moment:
    """What :func:`judge` needs of a state that :func:`advance` led to with an actuation (B, 2, P, P)."""
    now = features_of(state.particles, model.num_robot_particles)
    cost = action_cost(actuation) if model.spec.weights.get("action") else None
    return Moment(state, actuation, observe(model, state), now, info_of(model, state, now), cost)


def advance(model: Model, state: EnvState, action: Tensor) -> tuple[EnvState, Tensor]:
    """Advance the physics by one control step.

    Elements that are not valid afterwards, see :func:`is_valid`, pass no gradient to what they came from. Gradients of
    constants that all elements share, such as a learned material of the task, need not be finite then.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in grid layout.

    Returns:
        The next state, and the actuation on the patch (B, 2, P, P) in Pa.
    """
    spec = model.spec
    valid: list[Tensor] = []  # where gradients may go back, known after the step
    guarded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tree.leaves((state, action)))
    if guarded:
        guard = functools.partial(_stop_gradients, valid=valid)
        state, action = tree.map(guard, tree.without_inference((state, action)))
    physics = state.physics
    solver = model.solver_for(physics)
    actuation = patch_field(action, spec.patch, physics.get("max_actuation", spec.max_actuation))
    centre = centre_in_window(spec.patch_centre, state.centre, state.origin)
    on_nodes = place(actuation, centre, solver.grid.resolution)
    particles = solver.step(
        state.particles, on_nodes, substeps=model.substeps, origin=state.origin, segment=model.segment
    )
    com = particles.x[:, : model.num_robot_particles].mean(1)
    com = torch.where(torch.isfinite(com).all(-1, keepdim=True), com, state.centre)  # the last that was finite
    origin = spec.window.origin(com) if spec.window.moves else state.origin
    after = replace(state, particles=particles, origin=origin, centre=com, steps=state.steps + 1)
    if guarded:
        valid.append(is_valid(model, after))
    return after, actuation


def _stop_gradients(value: Tensor, valid: list[Tensor]) -> Tensor:
    """Let no gradient of an element that is not valid pass: NaN would spread through parameters the batch shares."""
    if value.requires_grad:
        value = value.view_as(value)
        value.register_hook(lambda g: None if g is None else tree.where(valid[0], g, torch.zeros_like(g)))
    return value


def observe(model: Model, state: EnvState) -> Tensor:
    """Return the observation of a state.

    Args:
        model: The task.
        state: The state.

    Returns:
        (B, 3, 64, 64) uint8; particles whose numbers are not finite are not drawn.
    """
    return model.camera.observe(state.particles.x, state.particles.v, state.origin, state.centre)


def soft_observation(model: Model, state: EnvState) -> Tensor:
    """Return the observation as a smooth function of the state, for gradients.

    Each particle is spread over pixels by a quadratic B-spline, and the region around the robot and the obstacles move
    over pixels without steps. The derivative jumps only where entries of the image, or velocities of particles at
    5 m/s, saturate, at the edge of the simulated window, and where edges of obstacles meet edges of pixels.

    Args:
        model: The task.
        state: The state.

    Returns:
        (B, 3, 64, 64) floating point, from 0 to 255 as in the uint8 observation, but not rounded.
    """
    return model.camera.observe_smoothly(state.particles.x, state.particles.v, state.origin, state.centre)


def judge(model: Model, moment: Moment, *, soft: bool = False) -> StepResult:
    """Reward, termination and success.

    Elements whose state is not valid, see :func:`is_valid`, end with the term ``failure`` = :data:`FAILURE_REWARD`.

    Args:
        model: The task.
        moment: After the step.
        soft: As in :func:`step`.
    """
    spec, (state, actuation, observation, now, info, cost) = model.spec, moment
    valid = info["finite"]
    transition = _transition(model, state, now, observation, EXACT)
    reward = spec.reward_fn(transition, spec)
    terms, total = _weighted(spec, reward, transition, cost, valid)
    image, true_total = None, total
    if soft:
        image = soft_observation(model, state)
        transition = transition._replace(observation=image, ops=SMOOTH)
        terms, total = _weighted(spec, spec.reward_fn(transition, spec), transition, cost, valid)
    terminated = ~valid if reward.terminated is None else reward.terminated | ~valid
    if spec.split_limit is not None:
        terminated = terminated | (now.radius_of_gyration > spec.split_limit)
    if reward.task_state is not None:  # a copy: it may hold what info does
        state = replace(state, task_state=tree.map(Tensor.clone, dict(reward.task_state)))
    success = None if reward.success is None else reward.success & valid
    info = info | dict(reward.info or {})
    return StepResult(state, observation, total, terms, terminated, success, info, true_total, actuation, image)


def info_of(model: Model, state: EnvState, now: Features) -> dict[str, Tensor]:
    """What ``info`` holds in every task, by name, of a state and its averages ``now``."""
    info = {"com": now.com, "split": now.radius_of_gyration, "finite": is_valid(model, state)}
    return info if now.object_com is None else {**info, "object_com": now.object_com}


def is_valid(model: Model, state: EnvState) -> Tensor:
    """Return which simulations can go on: all their numbers are finite, and some of the robot is in the window.

    Beyond :data:`FAR` from the window a position counts as not finite: the simulation has blown up.

    Args:
        model: The task.
        state: The state.

    Returns:
        (B,) bool.
    """
    x, origin = state.particles.x.detach(), state.origin.detach()
    near = ((x - origin[:, None]).abs() < FAR).flatten(1).all(1)
    return near & state.particles.is_finite() & contains(x[:, : model.num_robot_particles], origin).any(1)


def _transition(model: Model, state: EnvState, now: Features, observation: Tensor, ops: RewardOps) -> Transition:
    robot, start, task_state = model.num_robot_particles, state.start, state.task_state
    return Transition(state.particles, robot, now, start, observation, task_state, ops)


def _weighted(
    spec: TaskSpec, reward: Reward, transition: Transition, cost: Tensor | None, valid: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Weighted terms and their sum; of simulations that are not valid (B,) only ``failure`` counts."""
    terms, weights, radius = dict(reward.terms), spec.weights, transition.now.radius_of_gyration
    if spec.split_limit is not None:
        terms["split"] = transition.ops.split_penalty(radius, spec.split_limit)
    if cost is not None:
        terms["action"] = -cost
    terms["alive"] = constant(1.0, radius).expand_as(radius)
    terms["failure"] = constant(0.0, radius).expand_as(radius)
    factors, failed = _columns(tuple(weights.get(name, 0.0) for name in terms), radius.dtype, radius.device)
    values = torch.stack(tuple(terms.values())).to(factors) * factors
    counted = torch.where(valid, values, failed).unbind()
    # In an order that does not depend on the size of the batch, as that of Tensor.sum does.
    return dict(zip(terms, counted, strict=True)), sum(counted[1:], counted[0])


@cached_tensors
def _columns(weights: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Weights of terms, and their values in a simulation that is not valid, (K, 1) each; ``failure`` comes last."""
    rows = torch.tensor([(weight, 0.0) for weight in weights], dtype=torch.float64, device="cpu")
    rows[-1, 1] = FAILURE_REWARD
    factors, failed = rows.to(device, dtype)[..., None].unbind(1)
    return factors, failed


@torch.no_grad()
def check_rewards(model: Model, positions: Tensor) -> set[str]:
    """Call a task's functions once, right after a reset, and refuse what they must not return.

    Args:
        model: The task.
        positions: (B, N, 2), m. With three simulations, numbers for one alone, and those of x and y, are found as well.

    Returns:
        The names of the task's state.

    Raises:
        TypeError: ``reward_fn`` returns no :class:`dittogym.rewards.Reward`, or something without names.
        ValueError: A name or a shape is not allowed, or ``spec.weights`` do not fit the terms.
    """
    spec, batch = model.spec, len(positions)
    state, observation = reset(model, positions)
    transition = _transition(model, state, state.start, observation, EXACT)
    reward, who = spec.reward_fn(transition, spec), f"reward_fn of task {spec.name!r}"
    if not isinstance(reward, Reward):
        raise TypeError(f"{who} must return a Reward, got {type(reward).__name__}")
    for what, values in (("terms", reward.terms), ("info", reward.info), ("task_state", reward.task_state)):
        if not isinstance(values, Mapping) and (values is not None or what == "terms"):
            raise TypeError(f"{who} must return {what} by name, got {_kind(values)}")
    info, weights = reward.info or {}, spec.weights
    for part, taken in (("terms", RESERVED_TERMS & reward.terms.keys()), ("info", RESERVED_INFO & info.keys())):
        if taken:
            raise ValueError(f"{who} must not return the environment's own {part}, got {sorted(taken)}")
    for name in (*reward.terms, *info):  # Gymnasium puts a mask _name beside every entry of a batch's info
        if not isinstance(name, str) or name.startswith(("_", "reward_terms/")):
            raise ValueError(f"{who} must return names that do not begin with _ or reward_terms/, got {name!r}")
    if missing := [name for name in reward.terms if name not in weights]:
        raise ValueError(f"weights of task {spec.name!r} must hold every term of reward_fn, got none for {missing}")
    weighted = {*reward.terms, *RESERVED_TERMS} - {"failure"}  # the penalty of a failure has its own amount
    if unknown := sorted(weights.keys() - weighted):
        raise ValueError(f"weights of task {spec.name!r} must be of the terms {sorted(weighted)}, got {unknown}")
    for name, value in reward.terms.items():
        if not isinstance(value, Tensor) or value.shape != (batch,) or value.is_complex():
            found = f"{_kind(value)} for {name!r}"
            raise ValueError(f"{who} must return terms of shape (B,) in real numbers, got {found}")
        if not value.isfinite().all():
            raise ValueError(f"{who} must return finite terms, got {value.tolist()} for {name!r} at the start")
    for name, flag in (("terminated", reward.terminated), ("success", reward.success)):
        if flag is not None and not (isinstance(flag, Tensor) and (flag.dtype, *flag.shape) == (torch.bool, batch)):
            raise ValueError(f"{who} must return {name} as bool of shape (B,), got {_kind(flag)}")
    _check_leading(who, "info", info, batch)
    if reward.task_state is not None:
        before, after = ({n: _kind(v) for n, v in each.items()} for each in (state.task_state, reward.task_state))
        if before != after:
            raise ValueError(f"{who} must return task_state like initial_task_state, {before}, got {after}")
    return set(state.task_state)


def _check_leading(who: str, what: str, values: Mapping[str, object], batch: int) -> None:
    for name, value in values.items():
        if not isinstance(value, Tensor) or value.shape[:1] != (batch,):
            raise ValueError(f"{who} must return {what} of shape (B, ...), got {_kind(value)} for {name!r}")


def _kind(value: object) -> str:
    """Type and shape of a tensor, type of anything else, for messages."""
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
