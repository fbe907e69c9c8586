"""An environment as pure functions: initial state, transition, observation, judgement. No tensor lives here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dittogym import observation as obs
from dittogym.action import patch_field, place
from dittogym.reward import action_cost, measure, split_penalty
from dittogym.spec import FAILURE_REWARD, Measurement, Moment, Outcome, TaskSpec
from dittogym.window import in_window, window_origin
from torchmpm import Body, Elastic, Grid, ParticleState, Solver, VonMises, diagnostics


@dataclass(frozen=True, eq=False)
class EnvState:
    """Everything that an episode needs to go on; leading dimension B throughout.

    Attributes:
        particles: The matter.
        origin: (B, 2) lower left corner of the window in the world, m.
        centre: (B, 2) the robot's centre on which the next action is placed, m.
        start: Averages right after the reset.
        memory: What the task remembers.
        steps: (B,) int64 control steps taken.
    """

    particles: ParticleState
    origin: Tensor
    centre: Tensor
    start: Measurement
    memory: Mapping[str, Tensor]
    steps: Tensor

    def where(self, mask: Tensor, other: EnvState) -> EnvState:
        """Whole batch elements from this state where ``mask`` (B,) holds, from ``other`` elsewhere."""

        def choose(mine: Tensor, theirs: Tensor) -> Tensor:
            return torch.where(mask.view(-1, *[1] * (mine.ndim - 1)), mine, theirs)

        return EnvState(
            particles=self.particles.where(mask, other.particles),
            origin=choose(self.origin, other.origin),
            centre=choose(self.centre, other.centre),
            start=self.start.map(choose, other.start),
            memory={name: choose(value, other.memory[name]) for name, value in self.memory.items()},
            steps=choose(self.steps, other.steps),
        )

    def detach(self) -> EnvState:
        """The same numbers, cut off from the autograd graph."""
        return replace(
            self,
            particles=self.particles.detach(),
            origin=self.origin.detach(),
            centre=self.centre.detach(),
            start=self.start.map(Tensor.detach),
            memory={name: value.detach() for name, value in self.memory.items()},
        )


@dataclass(frozen=True, eq=False)
class Model:
    """A task at a certain fidelity: what turns one :class:`EnvState` into the next.

    Attributes:
        spec: The task.
        solver: Its physics.
        substeps: Substeps of a control step.
        share: Full-size particles that one particle stands for; ``None`` for the reference's pixel raster.
    """

    spec: TaskSpec
    solver: Solver
    substeps: int
    share: float | None

    @property
    def robot(self) -> int:
        """Number of robot particles."""
        return self.solver.bodies[0].count


def make_model(
    spec: TaskSpec, counts: tuple[int, ...], *, substeps: int, backend: str, unscaled: bool = False
) -> Model:
    """Build the physics of a task.

    Mass and volume of particles are scaled by full-size over actual count of the robot, so that density and stiffness
    of the bodies mean the same at every tier.

    Args:
        spec: The task.
        counts: Particles of each body.
        substeps: Substeps of a control step.
        backend: Of the solver.
        unscaled: As in the reference: unit volumes, and the pixel raster, whatever the counts.
    """
    full = counts == tuple(body.count for body in spec.bodies)
    share = 1.0 if unscaled else spec.robot.count / counts[0]
    robot = VonMises(spec.mu, spec.lam, spec.yield_stress)
    bodies = [
        Body(n, robot if i == 0 else Elastic(spec.mu, spec.lam), share * body.mass, share, muscle=i == 0)
        for i, (body, n) in enumerate(zip(spec.bodies, counts, strict=True))
    ]
    solver = Solver(
        Grid(),
        tuple(bodies),
        gravity=spec.gravity,
        damping=spec.damping,
        rules=tuple(rule for obstacle in spec.obstacles for rule in obstacle.rules),
        backend=backend,
    )
    return Model(spec, solver, substeps, share=None if full or unscaled else share)


def initial(model: Model, positions: Tensor) -> EnvState:
    """State right after a reset with particles at rest at ``positions`` (B, N, 2), m."""
    particles = ParticleState.at_rest(positions)
    start = measure(particles, model.robot)
    origin = window_origin(model.spec, start.com)
    steps = torch.zeros(len(positions), dtype=torch.int64, device=positions.device)
    state = EnvState(particles, origin, start.com, start, {}, steps)
    memory = model.spec.remember(_moment(model, state, start, observe(model, state)))
    return replace(state, memory=memory)


def transition(model: Model, state: EnvState, action: Tensor) -> tuple[EnvState, Tensor]:
    """Advance by one control step.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in grid layout.

    Returns:
        The next state, and the actuation on the patch (B, 2, P, P) in Pa.
    """
    spec, grid = model.spec, model.solver.grid
    field = patch_field(action, spec.patch, spec.max_actuation)
    on_nodes = place(field, in_window(spec.reach, state.centre, state.origin), grid.resolution)
    particles = model.solver.step(state.particles, on_nodes, substeps=model.substeps, origin=state.origin)
    com = particles.x[:, : model.robot].mean(1)
    origin = state.origin if spec.window.follow is None else window_origin(spec, com)
    return replace(state, particles=particles, origin=origin, centre=com, steps=state.steps + 1), field


def observe(model: Model, state: EnvState) -> Tensor:
    """The image (B, 3, 64, 64) uint8; particles that are not finite are not drawn."""
    spec = model.spec
    particles, origin = state.particles.detach(), state.origin.detach()
    finite = torch.isfinite(particles.x).all(-1) & torch.isfinite(particles.v).all(-1)
    seen = finite & model.solver.grid.contains(particles.x[..., 0], origin[:, 0:1])
    position = particles.x - origin[:, None]
    velocity = (2.0 * torch.where(seen[..., None], particles.v, 0.0)).clamp(-obs.CLIP, obs.CLIP)
    row, column = obs.crop_corner(in_window(spec.view, state.centre.detach(), origin))
    boxes = [box for obstacle in spec.obstacles for box in obstacle.drawn]
    mask = obs.background(boxes, origin, row, column)
    if model.share is None:
        return obs.quantise(obs.pixel_means(position, velocity, seen, row, column, mask))
    return obs.quantise(obs.splat_means(position, velocity, seen, row, column, mask, model.share))


def judge(model: Model, state: EnvState, field: Tensor, observation: Tensor) -> tuple[EnvState, Outcome]:
    """Reward terms, termination and success after a transition.

    Elements whose state is not finite end with the single term ``failure`` = :data:`dittogym.spec.FAILURE_REWARD`;
    their neighbours are not touched.

    Returns:
        The state with the task's memory brought up to date, and the outcome with ``terminated`` always given and
        ``info`` holding ``com``, ``split``, ``finite`` and the task's own quantities.
    """
    spec = model.spec
    weights = spec.weights
    now = measure(state.particles, model.robot)
    own = spec.judge(_moment(model, state, now, observation), weights)
    finite = diagnostics.finite(state.particles)
    terms = dict(own.terms)
    terminated = torch.zeros_like(finite) if own.terminated is None else own.terminated
    if spec.split_limit is not None:
        penalty, torn = split_penalty(now.split, spec.split_limit)
        terms["split"] = weights.split * penalty
        terminated = terminated | torn
    if weights.action:
        terms["action"] = -weights.action * action_cost(field)
    terms["alive"] = torch.full_like(now.split, weights.alive)
    terms = {name: torch.where(finite, term, 0.0) for name, term in terms.items()}
    terms["failure"] = torch.where(finite, 0.0, FAILURE_REWARD).to(now.split)
    info = {"com": now.com, "split": now.split, "finite": finite, **own.info}
    if now.object_com is not None:
        info["object_com"] = now.object_com
    success = own.success & finite if own.success is not None else None
    state = state if own.memory is None else replace(state, memory=own.memory)
    return state, Outcome(terms, terminated | ~finite, success, info)


def _moment(model: Model, state: EnvState, now: Measurement, observation: Tensor) -> Moment:
    return Moment(state.particles, model.robot, now, state.start, observation, state.memory)
