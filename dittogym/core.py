"""An environment as pure functions: initial state, transition, observation, judgement. No tensor lives here."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dittogym.action import patch_field, place
from dittogym.observation import native
from dittogym.observation import raster as obs
from dittogym.observation.window import in_window, window_origin
from dittogym.physics import Physics, part_of
from dittogym.rewards import action_cost, measure, split_penalty
from dittogym.spec import FAILURE_REWARD, Measurement, Moment, Outcome, TaskSpec
from torchmpm import Body, Elastic, Grid, ParticleState, Solver, VonMises, diagnostics, tree
from torchmpm.rollout import Segment

#: Terms that the engine adds to those of a task.
RESERVED = {"split", "action", "alive", "failure"}
#: What it puts into ``info`` itself.
RESERVED_INFO = {"com", "split", "finite", "object_com", "reward_terms", "is_success", "true_reward"}


@tree.register
@dataclass(frozen=True, eq=False)
class EnvState:
    """Everything that an episode needs to go on; leading dimension B throughout.

    Attributes:
        particles: The matter.
        origin: (B, 2) lower left corner of the window in the world, m.
        centre: (B, 2) the robot's centre on which the next action is placed, m.
        start: Averages right after the reset.
        memory: What the task remembers.
        physics: Constants that differ from the task's, see :func:`dittogym.physics.physics_values`.
        steps: (B,) int64 control steps taken.
    """

    particles: ParticleState
    origin: Tensor
    centre: Tensor
    start: Measurement
    memory: Mapping[str, Tensor]
    physics: Physics
    steps: Tensor

    def where(self, mask: Tensor, other: EnvState) -> EnvState:
        """Whole batch elements from this state where ``mask`` (B,) holds, from ``other`` elsewhere."""
        return tree.where(mask, self, other)

    def detach(self) -> EnvState:
        """The same numbers, cut off from the autograd graph."""
        return tree.detach(self)


@dataclass(frozen=True, eq=False)
class Model:
    """A task at a certain fidelity: what turns one :class:`EnvState` into the next.

    Attributes:
        spec: The task.
        solver: Its physics.
        substeps: Substeps of a control step.
        shares: By body, the full-size particles that one particle stands for.
        pixels: Whether observations use the reference's pixel raster.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
    """

    spec: TaskSpec
    solver: Solver
    substeps: int
    shares: tuple[float, ...]
    pixels: bool
    segment: Segment = "auto"

    @functools.cached_property
    def painter(self) -> native.Painter:
        """Draws observations where the physics runs natively."""
        return native.Painter(self)

    @property
    def robot(self) -> int:
        """Number of robot particles."""
        return self.solver.bodies[0].count

    def solver_for(self, physics: Physics) -> Solver:
        """The solver with the constants of :func:`dittogym.physics.physics_values` in place of the task's own."""
        if not physics:
            return self.solver
        counts = tuple(body.count for body in self.solver.bodies)
        bodies = _bodies(self.spec, counts, self.shares, physics)
        return self.solver.with_constants(bodies, physics.get("gravity", self.spec.gravity))

    def per_particle(self, values: tuple[float, ...] | tuple[bool, ...], like: Tensor) -> Tensor:
        """Values of the bodies as (N,) over all particles: truth values, or numbers like ``like``."""
        dtype = torch.bool if isinstance(values[0], bool) else like.dtype
        return _per_particle(tuple(body.count for body in self.solver.bodies), values, dtype, like.device)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)  # what is kept must serve gradients later
def _per_particle(
    counts: tuple[int, ...], values: tuple[float, ...] | tuple[bool, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    host = torch.device("cpu")
    repeats = torch.tensor(counts, device=host)
    return torch.tensor(values, dtype=dtype, device=host).repeat_interleave(repeats).to(device)


def make_model(
    spec: TaskSpec,
    counts: tuple[int, ...],
    *,
    substeps: int,
    backend: str,
    unscaled: bool = False,
    segment: Segment = "auto",
) -> Model:
    """Build the physics of a task.

    Mass and volume of a body's particles are scaled by full-size over actual count, so that density and stiffness mean
    the same at every tier.

    Args:
        spec: The task.
        counts: Particles of each body.
        substeps: Substeps of a control step.
        backend: Of the solver.
        unscaled: As in the reference: unit volumes, and the pixel raster, whatever the counts.
        segment: See :class:`Model`.

    Raises:
        ValueError: The matter is too stiff, see :func:`check_stability`.
    """
    full = counts == tuple(body.count for body in spec.bodies)
    shares = tuple(1.0 if unscaled else body.count / n for body, n in zip(spec.bodies, counts, strict=True))
    solver = Solver(
        Grid(),
        _bodies(spec, counts, shares, {}),
        gravity=spec.gravity,
        damping=spec.damping,
        rules=tuple(rule for obstacle in spec.obstacles for rule in obstacle.rules),
        backend=backend,
        allow_unstable=True,  # checked with the muscles, here and when a reset changes the matter
    )
    model = Model(spec, solver, substeps, shares, pixels=full or unscaled, segment=segment)
    check_stability(model, {})
    return model


def check_stability(model: Model, physics: Physics) -> None:
    """Refuse matter that the solver's substep is too long for.

    Args:
        model: The task.
        physics: Constants that differ from the task's.

    Raises:
        ValueError: Substeps would have to be shorter.
    """
    solver = model.solver_for(physics)
    limit = solver.stable_dt(physics.get("max_actuation", model.spec.max_actuation))
    if solver.dt > limit:
        raise ValueError(
            f"mu, lam, max_actuation and mass must be such that substeps of {solver.dt} s are stable, got matter so "
            f"stiff and light that they would have to be at most {limit} s"
        )


def _bodies(spec: TaskSpec, counts: tuple[int, ...], shares: tuple[float, ...], physics: Physics) -> tuple[Body, ...]:
    values = {name: getattr(spec, name) for name in ("mu", "lam", "yield_stress")} | {"mass": 1.0} | dict(physics)
    bodies: list[Body] = []
    for body, count, share in zip(spec.bodies, counts, shares, strict=True):
        first, robot = sum(earlier.count for earlier in bodies), not bodies
        own = {name: part_of(value, slice(first, first + count)) for name, value in values.items()}
        elastic = Elastic(own["mu"], own["lam"])
        material = VonMises(own["mu"], own["lam"], own["yield_stress"]) if robot else body.material or elastic
        bodies.append(Body(count, material, share * body.mass * own["mass"], share, muscle=robot))
    return tuple(bodies)


def initial(model: Model, positions: Tensor, physics: Physics | None = None) -> tuple[EnvState, Tensor]:
    """State and observation right after a reset with particles at rest at ``positions`` (B, N, 2), m."""
    particles = ParticleState.at_rest(positions)
    start = measure(particles, model.robot)
    origin = window_origin(model.spec, start.com)
    steps = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    state = EnvState(particles, origin, start.com, start, {}, physics or {}, steps)
    observation = observe(model, state)
    memory = model.spec.remember(_moment(model, state, start, observation))
    if not isinstance(memory, Mapping):
        raise TypeError(f"remember of task {model.spec.name!r} must return tensors by name, got {_kind(memory)}")
    _check_leading(model.spec, "remember", "memory", memory, steps)
    if missing := [name for name in model.spec.stale if name not in memory]:
        raise ValueError(
            f"stale of task {model.spec.name!r} must be names that remember returns, {sorted(memory)}, got {missing}"
        )
    return replace(state, memory=memory), observation


class Shield:
    """Keeps what simulations share free of the gradients of those that are not finite after a step.

    Such an element ends with a constant reward, whose derivative is zero. Where autograd goes back through the step it
    meets zero times infinity, and a sum over the batch, such as the gradient in a shared action or constant, would be
    no number for all.
    """

    def __init__(self) -> None:
        self.used = False
        self.finite: Tensor | None = None

    def __call__(self, value: Tensor) -> Tensor:
        """``value`` (B, ...), through which only gradients of finite elements go back."""
        if not value.requires_grad:
            return value
        self.used = True
        view = value.view_as(value)
        view.register_hook(self._stop)
        return view

    def _stop(self, gradient: Tensor) -> Tensor:
        return gradient if self.finite is None else tree.where(self.finite, gradient, torch.zeros_like(gradient))


def transition(model: Model, state: EnvState, action: Tensor) -> tuple[EnvState, Tensor]:
    """Advance by one control step.

    Elements that are not finite afterwards have no gradient in what they came from.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in grid layout.

    Returns:
        The next state, and the actuation on the patch (B, 2, P, P) in Pa.
    """
    shield = Shield()
    if torch.is_grad_enabled():
        shielded, action = tree.map(shield, state), shield(action)
        state = shielded if shield.used else state  # which need not be stacked anew
    spec, solver = model.spec, model.solver_for(state.physics)
    field = patch_field(action, spec.patch, state.physics.get("max_actuation", spec.max_actuation))
    on_nodes = place(field, in_window(spec.reach, state.centre, state.origin), solver.grid.resolution)
    particles = solver.step(
        state.particles, on_nodes, substeps=model.substeps, origin=state.origin, segment=model.segment
    )
    if shield.used:
        shield.finite = diagnostics.finite(particles)
    com = particles.x[:, : model.robot].mean(1)
    com = torch.where(torch.isfinite(com).all(-1, keepdim=True), com, state.centre)  # the last that was finite
    origin = state.origin if spec.window.follow is None else window_origin(spec, com)
    return replace(state, particles=particles, origin=origin, centre=com, steps=state.steps + 1), field


def observe(model: Model, state: EnvState) -> Tensor:
    """The image (B, 3, 64, 64) uint8; particles that are not finite are not drawn."""
    if native.paints(model, state):
        return model.painter.paint(state)
    spec = model.spec
    particles, origin = state.particles.detach(), state.origin.detach()
    row, column = obs.crop_corner(in_window(spec.view, state.centre.detach(), origin))
    background = _background(spec, origin, row, column)
    sight = look(model, particles, origin, row, column, background)
    if model.pixels:
        return obs.quantise(obs.pixel_means(sight))
    return obs.quantise(obs.splat_means(sight, model.per_particle(model.shares, origin)))


def look(
    model: Model,
    particles: ParticleState,
    origin: Tensor,
    row: Tensor,
    column: Tensor,
    background: obs.Background | None = None,
) -> obs.Sight:
    """What an image of the window at ``origin`` (B, 2), m, with its corner in a fine ``row`` and ``column`` shows."""
    finite = torch.isfinite((particles.x + particles.v).detach().sum(-1))
    seen = finite & model.solver.grid.contains(particles.x[..., 0], origin[:, 0:1])
    visible = tuple(body.moves_visibly for body in model.spec.bodies)
    silent = None if all(visible) else ~model.per_particle(visible, origin)
    speaks = seen if silent is None else seen & ~silent
    return obs.Sight(
        position=particles.x - origin[:, None],
        velocity=(2.0 * torch.where(speaks[..., None], particles.v, 0.0)).clamp(-obs.CLIP, obs.CLIP),
        seen=seen,
        silent=silent,
        row=row,
        column=column,
        background=background,
    )


def _background(spec: TaskSpec, origin: Tensor, row: Tensor, column: Tensor) -> obs.Background | None:
    boxes = spec.drawn
    if boxes and spec.window.follow is None and None not in spec.view:
        corner = int(row[0, 0]), int(column[0, 0])
        return obs.draw_boxes_once(boxes, (spec.window.left, 0.0), *corner, origin.dtype, origin.device)
    return obs.draw_boxes(boxes, origin, row, column)


def judge(
    model: Model, state: EnvState, field: Tensor, observation: Tensor, *, soft: bool = False
) -> tuple[EnvState, Outcome]:
    """Reward terms, termination and success after a transition.

    Elements whose state is not finite, or whose robot has left the window, end with the single term ``failure`` =
    ``dittogym.spec.FAILURE_REWARD``; their neighbours are not touched.

    Args:
        model: The task.
        state: After the transition.
        field: (B, 2, P, P) actuation on the patch, Pa.
        observation: (B, 3, 64, 64) uint8, or the soft one.
        soft: Smooth terms, from the soft observation; then only the terms of the outcome mean anything.

    Raises:
        ValueError: The task returns a term under a name of :data:`RESERVED`, info under one of :data:`RESERVED_INFO`,
            something without a leading B, a term that is not finite although the simulation is, or memory unlike that
            which it remembers.
        TypeError: The task returns something else.

    Returns:
        The state with the task's memory brought up to date, and the outcome with ``terminated`` always given and
        ``info`` holding ``com``, ``split``, ``finite`` and the task's own quantities.
    """
    spec = model.spec
    weights = spec.weights
    now = measure(state.particles, model.robot)
    own = spec.judge(_moment(model, state, now, observation, soft), weights)
    _check_outcome(spec, own, state)
    common, terms = averages(model, state, now), dict(own.terms)
    finite = common["finite"]
    terminated = torch.zeros_like(finite) if own.terminated is None else own.terminated
    if spec.split_limit is not None:
        penalty, torn = split_penalty(now.split, spec.split_limit, soft=soft)
        terms["split"] = weights.split * penalty
        terminated = terminated | torn
    if weights.action:
        terms["action"] = -weights.action * action_cost(field)
    terms["alive"] = torch.full_like(now.split, weights.alive)
    values = torch.stack(tuple(terms.values()))
    _check_finite(spec, terms, values, finite)
    terms = dict(zip(terms, torch.where(finite, values, 0.0).unbind(), strict=True))
    terms["failure"] = torch.where(finite, 0.0, FAILURE_REWARD).to(now.split)
    info = {**common, **own.info}
    success = own.success & finite if own.success is not None else None
    if own.memory is not None:  # a copy: it may hold what info does
        state = replace(state, memory={name: value.clone() for name, value in own.memory.items()})
    return state, Outcome(terms, terminated | ~finite, success, info)


def _check_finite(spec: TaskSpec, names: Iterable[str], values: Tensor, finite: Tensor) -> None:
    """Refuse terms (K, B) that are not finite where the simulations (B,) are."""
    wrong = ~torch.isfinite(values.detach()) & finite
    if bool(wrong.any()):
        term, element = wrong.nonzero()[0].tolist()
        raise ValueError(
            f"judge of task {spec.name!r} must return finite terms where the simulation is finite, "
            f"got {values[term, element].item()} for {list(names)[term]!r} in simulation {element}"
        )


def _check_outcome(spec: TaskSpec, own: Outcome, state: EnvState) -> None:
    """Refuse what a task must not return, see :func:`judge`."""
    if not isinstance(own, Outcome):
        raise TypeError(f"judge of task {spec.name!r} must return an Outcome, got {type(own).__name__}")
    for part in ("terms", "info", "memory"):
        if (given := getattr(own, part)) is not None and not isinstance(given, Mapping):
            raise TypeError(f"judge of task {spec.name!r} must return {part} by name, got {_kind(given)}")
    if taken := RESERVED & own.terms.keys():
        raise ValueError(f"judge of task {spec.name!r} must not return the engine's own terms, got {sorted(taken)}")
    if taken := RESERVED_INFO & own.info.keys():
        raise ValueError(f"judge of task {spec.name!r} must not return the engine's own info, got {sorted(taken)}")
    answers = {name: value for name in ("terminated", "success") if (value := getattr(own, name)) is not None}
    for name, value in {**own.terms, **answers}.items():
        fits = isinstance(value, Tensor) and value.shape == state.steps.shape
        if not fits or (name in answers and value.dtype != torch.bool):
            wanted = f"{name} as bool" if name in answers else "terms"
            raise ValueError(
                f"judge of task {spec.name!r} must return {wanted} of shape (B,), got {_kind(value)} for {name!r}"
            )
    _check_leading(spec, "judge", "info", own.info, state.steps)
    before, after = ({n: _kind(v) for n, v in m.items()} for m in (state.memory, own.memory or state.memory))
    if before != after:
        raise ValueError(f"judge of task {spec.name!r} must return memory like that of remember, {before}, got {after}")


def _check_leading(spec: TaskSpec, function: str, what: str, values: Mapping[str, object], steps: Tensor) -> None:
    for name, value in values.items():
        if not isinstance(value, Tensor) or value.shape[:1] != steps.shape:
            raise ValueError(
                f"{function} of task {spec.name!r} must return {what} of shape (B, ...), "
                f"got {_kind(value)} for {name!r}"
            )


def _kind(value: object) -> str:
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__


def averages(model: Model, state: EnvState, now: Measurement) -> dict[str, Tensor]:
    """What ``info`` holds in every task, of a moment and its averages ``now``, by name."""
    info = {"com": now.com, "split": now.split, "finite": intact(model, state)}
    return info if now.object_com is None else {**info, "object_com": now.object_com}


def intact(model: Model, state: EnvState) -> Tensor:
    """Which simulations can go on, (B,) bool: all numbers are finite and some of the robot is in the window."""
    x = state.particles.x[:, : model.robot].detach()
    height = x[..., 1] - state.origin[:, 1:2]
    present = model.solver.grid.contains(x[..., 0], state.origin[:, 0:1]) & (height > 0) & (height < 1)
    return diagnostics.finite(state.particles) & present.any(1)


def _moment(model: Model, state: EnvState, now: Measurement, observation: Tensor, soft: bool = False) -> Moment:
    return Moment(state.particles, model.robot, now, state.start, observation, state.memory, soft)
