"""A task at a certain fidelity: its physics, its camera, and what moves in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from dittogym.contract import Measurement
from dittogym.observation.camera import Camera
from dittogym.physics import Physics, part_of
from dittogym.spec import DT, TaskSpec
from dittogym.window import GRID
from torchmpm import Body, Elastic, ParticleState, Solver, VonMises, tree
from torchmpm.rollout import Segment

#: The option ``parity``: with ``"reference"`` the behaviours of the reference implementation are brought back.
Parity = Literal["clean", "reference"]


@tree.register
@dataclass(frozen=True, eq=False)
class EnvState:
    """Everything that an episode needs to go on, a pytree of tensors; leading dimension B throughout.

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
    """A moment of an environment, see :meth:`dittogym.TorchEnv.save`.

    Attributes:
        task: Name of the task.
        counts: Particles of each body.
        particle_weight: By body, the full-size particles that one particle stands for.
        state: Everything that moves.
        observation: (B, 3, 64, 64) uint8.
    """

    task: str
    counts: tuple[int, ...]
    particle_weight: tuple[float, ...]
    state: EnvState
    observation: Tensor


torch.serialization.add_safe_globals([Snapshot, EnvState, Measurement])  # tensors, numbers and a name


@dataclass(frozen=True, eq=False)
class Model:
    """A task at a certain fidelity: what turns one :class:`EnvState` into the next.

    Attributes:
        spec: The task.
        solver: Its physics.
        substeps: Substeps of a control step.
        camera: Draws observations.
        segment: Substeps between checkpoints where gradients are enabled, see :meth:`torchmpm.Solver.step`.
        checked: Names that the task has returned so far.
    """

    spec: TaskSpec
    solver: Solver
    substeps: int
    camera: Camera
    segment: Segment = "auto"
    checked: set[tuple[object, ...]] = field(default_factory=set, repr=False)

    @property
    def num_robot_particles(self) -> int:
        """The robot's particles come first."""
        return self.solver.bodies[0].count

    def solver_for(self, physics: Physics) -> Solver:
        """The solver with the constants of :func:`dittogym.physics.physics_values` in place of the task's own."""
        if not physics:
            return self.solver
        bodies = _bodies(self.spec, self.camera.counts, self.camera.particle_weight, physics)
        return self.solver.with_constants(bodies, physics.get("gravity", self.spec.gravity))


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

    Mass and volume of a body's particles are scaled by full-size over actual count, so that density and stiffness mean
    the same at every tier.

    Args:
        spec: The task.
        counts: Particles of each body.
        substeps: Substeps of a control step.
        backend: Of the solver.
        parity: ``"reference"``: particles of unit volume and the pixel raster at every tier.
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
    native = backend in ("auto", "native") and solver.kernels.unsupported(torch.device("cpu")) is None
    hidden = tuple(body.hidden_velocity for body in spec.bodies)
    camera = Camera(spec.view, spec.window, spec.observed_boxes, counts, weight, hidden, pixels, native)
    model = Model(spec, solver, substeps, camera, segment)
    check_stability(model, {})
    return model


def check_stability(model: Model, physics: Physics) -> None:
    """Refuse matter that with its muscles needs shorter substeps."""
    solver = model.solver_for(physics)
    limit = solver.stable_dt(physics.get("max_actuation", model.spec.max_actuation))
    if solver.dt > limit:
        matter = "matter of these mu, lam, max_actuation and mass"
        raise ValueError(f"dt must be at most {limit} s to be stable with {matter}, got {solver.dt}")


def _bodies(spec: TaskSpec, counts: tuple[int, ...], weight: tuple[float, ...], physics: Physics) -> tuple[Body, ...]:
    values = {name: getattr(spec, name) for name in ("mu", "lam", "yield_stress")} | {"mass": 1.0} | dict(physics)
    bodies: list[Body] = []
    for body, count, w in zip(spec.bodies, counts, weight, strict=True):
        first, robot = sum(earlier.count for earlier in bodies), not bodies
        own = {name: part_of(value, slice(first, first + count)) for name, value in values.items()}
        default = VonMises(own["mu"], own["lam"], own["yield_stress"]) if robot else Elastic(own["mu"], own["lam"])
        bodies.append(Body(count, body.material or default, w * body.mass * own["mass"], w, muscle=robot))
    return tuple(bodies)
