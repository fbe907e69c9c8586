"""The material point method: one substep, and steps of many."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchmpm import checks, muscle, native, transfer
from torchmpm.backends import BACKENDS, compiler_found, runs_native, substep_function, vmapping
from torchmpm.boundary import Face, VelocityRule, constrain, faces
from torchmpm.grid import PAD, Grid
from torchmpm.linalg import Mat2, matmul
from torchmpm.material import Material, Sym2, Value, column, spread
from torchmpm.native.library import NO_COMPILER
from torchmpm.rollout import Segment, check_repetition, reads, repeated, tensors
from torchmpm.spline import Stencil, stencil
from torchmpm.state import ParticleState

#: Added to the mass of a node before the division, kg, so that an empty node has velocity zero.
MASS_EPSILON = 1e-10


@dataclass(frozen=True, eq=False)
class Body:
    """A run of consecutive particles of one material.

    Attributes:
        count: Number of particles.
        material: Constitutive law, such as :class:`torchmpm.VonMises`.
        mass: Mass of a particle, kg; a number or a tensor of shape (), (B,) or (B, count).
        volume: Undeformed volume of a particle, m^2 (two-dimensional); a number, (), (B,) or (B, count).
        muscle: Whether the actuation field acts on it.

    Raises:
        ValueError: ``count`` is below 1, or ``mass`` or ``volume`` is not positive.
        TypeError: The material is not a :class:`torchmpm.Material`.
    """

    count: int
    material: Material
    mass: Value = 1.0
    volume: Value = 1.0
    muscle: bool = False

    def __post_init__(self) -> None:
        checks.whole("count", self.count, 1)
        checks.instance("material", self.material, Material)
        for name in ("mass", "volume"):
            checks.value(name, getattr(self, name), above=0.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same during one step, in the form the substep wants it.

    Attributes:
        grid: The window.
        origin: (B, 2) lower left corner of the window, m.
        mass: (B or 1, N) particle masses, kg.
        inside: (1, cells) 1 on nodes that exist, 0 on the padding.
        gravity: (2, B or 1, cells) velocity gained by gravity in a substep, m/s.
        damping: Factor on node velocities in a substep.
        faces: Velocity rules as masks.
        actuation: (2, B, cells) muscle actuation on the nodes, Pa, or ``None``.
    """

    grid: Grid
    origin: Tensor
    mass: Tensor
    inside: Tensor
    gravity: Tensor
    damping: float
    faces: tuple[Face, ...]
    actuation: Tensor | None


class Scattered(NamedTuple):
    """What the first half of a substep yields.

    Attributes:
        nodes: The stencils.
        inside: (B, N) which particles take part.
        F: Planes (B, N) of the returned deformation gradient.
        Jp: (B, N) plastic volume ratio.
        momentum: (3, B, cells) mass (kg) and momentum (kg m/s) on the nodes.
    """

    nodes: Stencil
    inside: Tensor
    F: Mat2
    Jp: Tensor
    momentum: Tensor


@dataclass(frozen=True, eq=False)
class Solver:
    """Explicit MLS-MPM with APIC transfers and quadratic B-splines on a window of nodes.

    A description without state: wherever a material value, a mass or gravity is a tensor, results are differentiable
    in it, and a tensor of shape (B,) gives each simulation of the batch its own value.

    Attributes:
        grid: The window of nodes.
        bodies: The particles in their order; their counts add up to N.
        gravity: Acceleration (x, y), m/s^2: two numbers, or a tensor of shape (2,) or (B, 2).
        damping: Factor on every node velocity in every substep (1 = none).
        rules: Velocity rules, see :class:`torchmpm.VelocityRule`.
        dt: Duration of a substep, s.
        backend: ``"native"`` (fused kernels, ``torchmpm.native``: C++ on the CPU, Triton on CUDA), ``"eager"`` or
            ``"compile"`` (see ``torchmpm.backends.substep_function``), or ``"auto"``: native on a CPU where it
            works, else eager.
        allow_unstable: Accept a ``dt`` beyond :meth:`stable_dt`.

    Raises:
        ValueError: No bodies, ``dt`` not positive or beyond :meth:`stable_dt`, ``damping`` negative, gravity not two
            numbers, or an unknown or unavailable backend.
        TypeError: ``grid``, a body or a rule is something else.
    """

    grid: Grid
    bodies: tuple[Body, ...]
    gravity: tuple[float, float] | Tensor = (0.0, 0.0)
    damping: float = 1.0
    rules: tuple[VelocityRule, ...] = ()
    dt: float = 1e-4
    backend: str = "auto"
    allow_unstable: bool = False

    def __post_init__(self) -> None:
        checks.instance("grid", self.grid, Grid)
        checks.instances("bodies", self.bodies, Body)
        if not self.bodies:
            raise ValueError("bodies must hold at least one Body, got none")
        checks.instances("rules", self.rules, VelocityRule)
        for name in ("bodies", "rules"):  # a list could change behind the tables that backends keep
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if not isinstance(self.gravity, Tensor):
            if not isinstance(self.gravity, Sequence) or len(self.gravity) != 2:
                raise ValueError(f"gravity must be two numbers (x, y) or a tensor, got {self.gravity!r}")
            for component, pull in zip("xy", self.gravity, strict=True):
                checks.number(f"gravity {component}", pull)
        checks.number("damping", self.damping, least=0.0)
        checks.number("dt", self.dt, above=0.0)
        if self.backend not in BACKENDS:
            raise ValueError(f"backend must be one of {BACKENDS}, got {self.backend!r}")
        if self.backend in ("compile", "native") and not compiler_found() and not torch.cuda.is_available():
            raise ValueError(f"backend {self.backend!r} {NO_COMPILER}")
        if not (self.allow_unstable or self._vmapped()) and self.dt > (limit := self.stable_dt()):
            raise ValueError(
                f"dt must be at most {limit} s for matter so stiff and light to be stable, got {self.dt}; "
                "allow_unstable=True accepts it"
            )

    @cached_property
    def tensors(self) -> dict[str, Tensor]:
        """Constants of the matter, and gravity, that are tensors; by names such as ``bodies[0].material.mu``."""
        return tensors({"bodies": self.bodies, "gravity": self.gravity})

    def _vmapped(self) -> bool:
        """Whether constants may be tensors of a ``vmap``, under which nothing can depend on the numbers they hold."""
        return vmapping() and bool(self.tensors)

    @property
    def num_particles(self) -> int:
        """N, the number of particles of all bodies."""
        return sum(body.count for body in self.bodies)

    def stable_dt(self, actuation: Value = 0.0) -> float:
        """Largest duration of a substep for which small strains of undeformed matter do not grow, s.

        ``h / sqrt((k + 2 |a|) V / m)``, least over all particles, with the stiffness k = 2 (mu + lam) and the actuation
        a. It holds however particles lie: the strain rate C of a particle cannot exceed what the kinetic energy of
        its nodes allows, ``h^2/4 |C|^2 <= sum w |v_i|^2``, and a particle alone reaches that. Large strains, and soil
        that has hardened, are stiffer and may need less.

        Args:
            actuation: Of the muscles, Pa; a number or a tensor of shape (), (B,) or (B, count).

        Raises:
            ValueError: Shapes of a body's values do not go together, or they are not finite or have a wrong sign.
        """
        rates = [0.0]
        for k, body in enumerate(self.bodies):
            try:
                pull = (
                    torch.as_tensor(spread(actuation), dtype=torch.float64, device="cpu").abs() if body.muscle else 0.0
                )
                rate = (body.material.stiffness() + 2.0 * pull) * spread(body.volume) / spread(body.mass)
            except RuntimeError as error:
                raise ValueError(f"values of bodies[{k}] must have shapes that go together: {error}") from error
            rate = torch.as_tensor(rate, dtype=torch.float64, device="cpu")
            if not bool(((rate >= 0) & torch.isfinite(rate)).all()):
                raise ValueError(
                    f"values of bodies[{k}] must be finite, its mass and volume positive and its stiffness not "
                    f"negative, got stiffness x volume / mass from {rate.min().item():g} to {rate.max().item():g}"
                )
            rates.append(float(rate.max()))
        fastest = math.sqrt(max(rates))
        return self.grid.h / fastest if fastest > 0 else math.inf

    def step(
        self,
        state: ParticleState,
        actuation: Float[Tensor, "B 2 G G"] | None = None,
        *,
        substeps: int = 1,
        origin: Float[Tensor, "B 2"] | None = None,
        segment: Segment = "auto",
    ) -> ParticleState:
        """Advance all simulations by ``substeps * dt`` seconds.

        Particles outside the window in x keep everything they have until the window comes back to them.

        Args:
            state: Where they are.
            actuation: (B, 2, G, G) muscle actuation in Pa on the nodes of the window, ``[:, 0]`` along material x,
                indices (i, j) rightwards and upwards; constant during the step, and felt only by bodies with
                ``muscle=True``. ``None`` for none.
            substeps: Number of substeps.
            origin: (B, 2) lower left corner of the window in the world, m; ``None`` for (0, 0).
            segment: Substeps between checkpoints when gradients are enabled, see :func:`torchmpm.repeated` and
                :func:`torchmpm.segment_for`. The native backend keeps the start of a segment and replays its substeps
                onto a tape; ``"auto"`` and ``None`` make its segments as long as the memory that it keeps for tapes.

        Returns:
            The new state, differentiable in state, actuation, origin, material values, masses, volumes and gravity.

        Raises:
            ValueError: Shapes, dtypes or devices do not fit together, or the native backend was chosen and cannot run
                this.
            TypeError: The state, the actuation or the origin is something else.
            RuntimeError: In the backward pass: one of these tensors was changed in place, and is read again there.
        """
        checks.instance("state", state, ParticleState)
        substeps, segment = check_repetition(substeps, segment, "substeps")
        origin = self.check(state, actuation, origin)
        if substeps == 0 or state.batch_size == 0:
            return state
        reads({"state": state, "actuation": actuation, "origin": origin} | self.tensors)
        if runs_native(self, state, actuation, origin):
            return native.step(self, state, actuation, origin, substeps, segment, mass_epsilon=MASS_EPSILON)
        substep = substep_function(self, self.scene(state, actuation, origin))
        return ParticleState.from_planes(repeated(substep, state.planes(), substeps, segment=segment))

    def check(self, state: ParticleState, actuation: Tensor | None, origin: Tensor | None) -> Tensor:
        """Check the arguments of a step, see :meth:`step`, and fill in the origin.

        Args:
            state: Where the particles are.
            actuation: (B, 2, G, G), Pa, or ``None``.
            origin: (B, 2), m, or ``None``.

        Returns:
            The origin (B, 2), m.

        Raises:
            ValueError: Shapes, dtypes or devices do not fit together.
        """
        batch, nodes = state.batch_size, self.grid.resolution
        if state.num_particles != self.num_particles:
            raise ValueError(f"state has {state.num_particles} particles, the solver's bodies {self.num_particles}")
        field_shape = (batch, 2, nodes, nodes)
        for name, value, shape in (("actuation", actuation, field_shape), ("origin", origin, (batch, 2))):
            if value is None:
                continue
            checks.instance(name, value, Tensor)
            if (tuple(value.shape), value.dtype, value.device) != (shape, state.dtype, state.device):
                raise ValueError(
                    f"{name} must be {state.dtype} on {state.device} of shape {shape}, "
                    f"got {value.dtype} on {value.device} of shape {tuple(value.shape)}"
                )
        gravity = self.gravity
        if isinstance(gravity, Tensor) and tuple(gravity.shape) not in ((2,), (1, 2), (batch, 2)):
            raise ValueError(f"gravity must have shape (2,) or ({batch}, 2), got {tuple(gravity.shape)}")
        return state.x.new_zeros(batch, 2) if origin is None else origin

    def scene(self, state: ParticleState, actuation: Tensor | None = None, origin: Tensor | None = None) -> Scene:
        """Check the arguments of a step and prepare what its substeps share; see :meth:`step`.

        Args:
            state: Where the particles are.
            actuation: (B, 2, G, G), Pa, or ``None``.
            origin: (B, 2), m, or ``None``.
        """
        origin, nodes = self.check(state, actuation, origin), self.grid.resolution
        inside = pad(state.x.new_ones(nodes, nodes), [PAD] * 4).flatten()[None]
        if actuation is not None:
            actuation = pad(actuation, [PAD] * 4).flatten(2).transpose(0, 1).contiguous()
        gravity = torch.as_tensor(self.gravity, dtype=state.dtype, device=state.device)
        return Scene(
            grid=self.grid,
            origin=origin,
            mass=self.per_particle(state, "mass"),
            inside=inside,
            gravity=(self.dt * gravity).reshape(-1, 2).T[..., None] * inside,
            damping=self.damping,
            faces=faces(self.rules, self.grid, origin),
            actuation=actuation,
        )

    def substep(self, scene: Scene, planes: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        """One substep: transfer to the grid, grid, transfer back.

        Args:
            scene: What the substeps of a step share.
            planes: The 13 component planes, (B, N) each, see :meth:`ParticleState.planes`.

        Returns:
            The new planes, (B, N) each.
        """
        x, y = planes[:2]
        grid = self.to_grid(scene, planes)
        v, C = transfer.grid_to_particles(self.grid, grid.nodes, grid_velocity(scene, grid.momentum))
        moved = (x + self.dt * v[0], y + self.dt * v[1], *v, *C, *grid.F, grid.Jp)
        return tuple(torch.where(grid.inside, new, old) for new, old in zip(moved, planes, strict=True))

    def to_grid(self, scene: Scene, planes: tuple[Tensor, ...]) -> Scattered:
        """First half of a substep: deform the particles, find their forces, collect mass and momentum on the nodes.

        Args:
            scene: What the substeps of a step share.
            planes: The 13 component planes, (B, N) each.
        """
        x, y, vx, vy, c0, c1, c2, c3, f0, f1, f2, f3, Jp = planes
        inside = self.grid.contains(x, scene.origin[:, 0:1])
        nodes = stencil(self.grid, x, y, scene.origin)
        growth = (1.0 + self.dt * c0, self.dt * c1, self.dt * c2, 1.0 + self.dt * c3)
        F, Jp, force = self._internal_force(scene, nodes, matmul(growth, (f0, f1, f2, f3)), Jp)
        momentum = transfer.particles_to_grid(
            self.grid, nodes, inside.to(x.dtype), (vx, vy), (c0, c1, c2, c3), scene.mass, force
        )
        return Scattered(nodes, inside, F, Jp, momentum)

    def _internal_force(self, scene: Scene, nodes: Stencil, trial: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor, Sym2]:
        """Return-mapped deformation and ``-dt V 4/h^2 tau`` of all bodies."""
        parts: list[tuple[Tensor, ...]] = []
        for body, part in self.parts():
            a, b, c, d = trial
            before = Jp[:, part]
            F, after = body.material.return_map((a[:, part], b[:, part], c[:, part], d[:, part]), before)
            xx, xy, yy = body.material.stress(F, before)
            if body.muscle and scene.actuation is not None:
                pull = muscle.muscle_stress(F, muscle.sample(nodes.part(part), scene.actuation))
                xx, xy, yy = xx + pull[0], xy + pull[1], yy + pull[2]
            factor = -self.dt * (4.0 / self.grid.h**2) * column(body.volume, before, "volume")
            parts.append((*F, after, factor * xx, factor * xy, factor * yy))
        planes = zip(*parts, strict=True)
        f0, f1, f2, f3, Jp, xx, xy, yy = (p[0] if len(p) == 1 else torch.cat(p, dim=1) for p in planes)
        return (f0, f1, f2, f3), Jp, (xx, xy, yy)

    def parts(self) -> Iterator[tuple[Body, slice]]:
        """The bodies with their places among the particles."""
        start = 0
        for body in self.bodies:
            yield body, slice(start, start + body.count)
            start += body.count

    def per_particle(self, state: ParticleState, name: str) -> Tensor:
        """A value of the bodies as a plane over all particles.

        Args:
            state: Gives batch size, dtype and device.
            name: ``"mass"`` (kg) or ``"volume"`` (m^2).

        Returns:
            (1, N) or (B, N).
        """
        like = state.Jp.detach()
        columns = []
        for body, part in self.parts():
            value = column(getattr(body, name), like[:, part], name)
            columns.append(value * torch.ones_like(like[:1, part]))
        batch = max(len(c) for c in columns)
        return torch.cat([c.expand(batch, -1) for c in columns], dim=1)


def grid_velocity(scene: Scene, momentum: Tensor) -> Tensor:
    """Velocity of the nodes: normalise, accelerate, damp, constrain.

    Args:
        scene: The shared data of the step.
        momentum: (3, B, cells) mass and momentum from :func:`torchmpm.transfer.particles_to_grid`.

    Returns:
        (2, B, cells) velocities, m/s; zero on padding nodes.
    """
    velocity = momentum[1:] * (scene.inside / (momentum[0] + MASS_EPSILON)) + scene.gravity
    if scene.damping != 1.0:
        velocity = velocity * scene.damping
    return constrain(scene.faces, velocity)
