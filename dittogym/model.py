"""A task at a certain fidelity: its physics, its camera, and what moves in it."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from dittogym.contract import Measurement
from dittogym.observation.camera import Camera
from dittogym.physics import Physics, check_effect, merged, part_of, physics_values
from dittogym.spec import DT, TaskSpec
from dittogym.window import GRID
from torchmpm import Body, Elastic, ParticleState, Solver, VonMises, tree
from torchmpm.rollout import Segment
from torchmpm.stability import check_gravity, stable_dt

#: The option ``parity``: with ``"reference"`` the behaviours of the reference implementation are brought back.
Parity = Literal["clean", "reference"]


@tree.register
@dataclass(frozen=True, eq=False)
class EnvState:
    """The complete state of B episodes, a pytree of tensors with leading dimension B.

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

    def __getstate__(self) -> dict[str, Any]:
        """The fields, for pickles and deep copies, which cannot hold an autograd graph."""
        tree.refuse_graph("the state of a TorchEnv", self)
        return vars(self)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A saved state of an environment, see :meth:`dittogym.TorchEnv.save`.

    Attributes:
        kind: See :attr:`Model.kind`.
        state: Everything that moves.
        observation: (B, 3, 64, 64) uint8.
        constants: What else the environment that loads it must share, see :attr:`Model.constants`.
    """

    kind: tuple[str, tuple[int, ...], tuple[float, ...]]
    state: EnvState
    observation: Tensor
    constants: Mapping[str, str]


torch.serialization.add_safe_globals([Snapshot, EnvState, Measurement])  # tensors, numbers and a name


@dataclass(frozen=True, eq=False)
class Model:
    """A task with given particle counts and substeps: solver, camera and rewards, without state.

    Attributes:
        spec: The task.
        solver: Its physics.
        substeps: Substeps of a control step.
        camera: Draws observations.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
    """

    spec: TaskSpec
    solver: Solver
    substeps: int
    camera: Camera
    segment: Segment = "auto"

    @property
    def num_robot_particles(self) -> int:
        """The robot's particles come first."""
        return self.solver.bodies[0].count

    @property
    def kind(self) -> tuple[str, tuple[int, ...], tuple[float, ...]]:
        """The task's name, the particles of each body, and the full-size particles that one of them stands for."""
        return self.spec.name, self.camera.counts, self.camera.particle_weight

    @functools.cached_property
    def constants(self) -> dict[str, str]:
        """By name what determines an episode besides its state, as texts that are equal for equal values.

        Tensors that require gradients are identified by their shape alone, because training changes their values.
        """
        names = [each.name for each in fields(self.spec) if each.name not in ("coarse", "fine")]
        spec = {name: _as_text(getattr(self.spec, name)) for name in names}
        return {**spec, "substeps": str(self.substeps), "dt": str(self.solver.dt)}

    def solver_for(self, physics: Physics) -> Solver:
        """The solver with the constants of :func:`dittogym.physics.physics_values` in place of the task's own."""
        if not physics:
            return self.solver
        bodies = _bodies(self.spec, self.camera.counts, self.camera.particle_weight, physics)
        return self.solver.with_constants(bodies, physics.get("gravity", self.spec.gravity))


def _as_text(value: Any) -> str:
    if is_dataclass(value) and not isinstance(value, type):
        return _as_text([type(value).__name__, *(getattr(value, each.name) for each in fields(value))])
    if isinstance(value, Mapping):
        return _as_text(sorted(value.items()))
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_as_text, value))}]"
    if isinstance(value, Tensor):
        return f"{tuple(value.shape)} learned" if value.requires_grad else _as_text(value.detach().cpu().numpy())
    if isinstance(value, np.ndarray):
        return f"{tuple(value.shape)} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, functools.partial):
        return _as_text([value.func, value.args, value.keywords])
    if callable(value):
        return str(getattr(value, "__qualname__", type(value).__name__))
    text = repr(value)
    return type(value).__name__ if " at 0x" in text else text  # an address differs in another process


def make_model(
    spec: TaskSpec,
    counts: tuple[int, ...],
    substeps: int,
    backend: str,
    parity: Parity,
    segment: Segment = "auto",
    dt: float = DT,
) -> Model:
    """Build the physics of a task.

    Mass and volume of a body's particles are scaled by full over actual count, so that density and stiffness mean the
    same for every particle count.

    Args:
        spec: The task.
        counts: Particles of each body.
        substeps: Substeps of a control step.
        backend: Of the solver.
        parity: ``"reference"``: particles of unit volume and the pixel raster for every particle count.
        segment: See :class:`Model`.
        dt: Duration of a substep, s.
    """
    full = tuple(body.count for body in spec.bodies)
    weight = tuple(1.0 if parity == "reference" else n / m for n, m in zip(full, counts, strict=True))
    solver = Solver(
        GRID,
        _bodies(spec, counts, weight, {}),
        gravity=spec.gravity,
        damping=spec.damping ** (dt / DT),
        rules=tuple(rule for obstacle in spec.obstacles for rule in obstacle.velocity_rules),
        dt=dt,
        backend=backend,
        allow_unstable=True,  # checked with the muscles, here and when a reset changes the matter
    )
    pixels = parity == "reference" or counts == full
    native = backend in ("auto", "native")  # of the camera, which draws any matter
    hidden = tuple(body.hidden_velocity for body in spec.bodies)
    camera = Camera(spec.view, spec.window, spec.observed_boxes, counts, weight, hidden, pixels, native)
    model = Model(spec, solver, substeps, camera, segment)
    check_stability(model, {})
    return model


def check_stability(model: Model, physics: Physics) -> None:
    """Refuse matter that with its muscles needs shorter substeps, and gravity that does."""
    solver, actuation = model.solver_for(physics), physics.get("max_actuation", model.spec.max_actuation)
    limit = solver.stable_dt(actuation)
    if solver.dt > limit:
        robot = stable_dt(solver.bodies[:1], GRID.h, actuation) == limit
        matter = f"the material, muscles and mass of the {'robot' if robot else 'object'}"
        raise ValueError(f"dt must be at most {limit} s to be stable with {matter}, got {solver.dt}")
    name = "physics['gravity']" if "gravity" in physics else "gravity"
    check_gravity(name, solver.gravity, GRID.h, solver.dt)


def next_physics(model: Model, present: Physics, given: object, mask: Tensor, like: Tensor) -> Physics:
    """The constants of the next episodes: ``given`` for the elements in ``mask`` (B,), ``present`` for the others.

    ``like`` (B,) has the dtype and device of the simulations.
    """
    values = physics_values(given, model.solver.num_particles, like)
    check_effect(model.spec, values)
    physics = merged(model.spec, present, values, mask, like)
    check_stability(model, physics)
    return physics


def check_snapshot(model: Model, snapshot: Snapshot, like: Tensor) -> None:
    """Refuse a snapshot that does not fit the model and B simulations of dtype and device of ``like`` (B,)."""
    x, size = snapshot.state.particles.x, len(snapshot.state.steps)
    if size not in (1, len(like)):
        raise ValueError(f"snapshot must hold 1 simulation or as many as num_envs, {len(like)}, got {size}")
    own, theirs = (*model.kind, like.dtype, like.device), (*snapshot.kind, x.dtype, x.device)
    names = "task", "particles", "particle weights", "dtype", "device"
    for name, mine, given in zip(names, own, theirs, strict=True):
        if mine != given:
            raise ValueError(f"snapshot must have the environment's {name}, {mine}, got {given}")
    if others := [name for name, text in model.constants.items() if snapshot.constants.get(name) != text]:
        raise ValueError(f"snapshot must be of an environment with the same {', '.join(others)}, got another")


def _bodies(spec: TaskSpec, counts: tuple[int, ...], weight: tuple[float, ...], physics: Physics) -> tuple[Body, ...]:
    values = {name: getattr(spec, name) for name in ("mu", "lam", "yield_stress")} | {"mass": 1.0} | dict(physics)
    bodies: list[Body] = []
    for body, count, w in zip(spec.bodies, counts, weight, strict=True):
        first, robot = sum(earlier.count for earlier in bodies), not bodies
        own = {name: part_of(value, slice(first, first + count)) for name, value in values.items()}
        default = VonMises(own["mu"], own["lam"], own["yield_stress"]) if robot else Elastic(own["mu"], own["lam"])
        material = default if body.material is None else body.material
        bodies.append(Body(count, material, w * body.mass * own["mass"], w, muscle=robot))
    return tuple(bodies)
