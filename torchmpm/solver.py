"""The solver: a frozen description of grid, bodies and boundary, and the step that advances a state."""

import functools
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchmpm import checks, stability, tree
from torchmpm.backends import BACKENDS, warn_eager
from torchmpm.boundary import VelocityRule, constrain, faces
from torchmpm.checks import Segment
from torchmpm.grid import PAD, Grid
from torchmpm.materials.base import Value, lame, try_law
from torchmpm.materials.body import Body, per_particle, slices
from torchmpm.materials.von_mises import VonMises
from torchmpm.native.cuda.compiler import unavailable
from torchmpm.native.kernels import Kernels
from torchmpm.native.library import NO_COMPILER, leave_parent_threads, load, provenance
from torchmpm.native.tables import KINDS
from torchmpm.rollout import repeated
from torchmpm.sampling import disc, sobol
from torchmpm.state import ParticleState
from torchmpm.substep import Scene, substep
from torchmpm.tree import transforming


@dataclass(frozen=True, eq=False)
class Solver:
    """Explicit MLS-MPM with APIC transfers and quadratic B-splines on a window of nodes.

    The moving least squares material point method is that of Hu et al. ("A moving least squares material point method
    with displacement discontinuity and two-way rigid body coupling", 2018), the transfers between particles and nodes
    are those of Jiang et al. ("The affine particle-in-cell method", 2015).

    A solver is a description without state. Wherever a material constant, a mass, a volume or gravity is a tensor,
    results are differentiable with respect to it, and a tensor of shape (B,) gives each simulation of the batch its own
    value. A subclass, a frozen dataclass itself, may override :meth:`scene` and :meth:`boundary`.

    Attributes:
        grid: The window of nodes.
        bodies: The bodies in the order of their particles; their counts add up to N.
        gravity: Acceleration (x, y), m/s^2: two numbers, or a tensor of shape (2,) or (B, 2).
        damping: Factor on the velocities of all nodes in every substep, from 0 to 1; 1 is no damping.
        rules: Velocity rules, in order of precedence, see :class:`torchmpm.VelocityRule`.
        dt: Duration of a substep, s.
        backend: ``"native"`` for fused kernels, C++ on a CPU and CUDA C++ on a GPU; ``"eager"`` for PyTorch operations,
            which take any material, transforms of ``torch.func`` and second derivatives; ``"auto"`` for native where it
            works and eager elsewhere, with the reason logged once.
        allow_unstable: Accept a ``dt`` above :meth:`stable_dt`, and gravity with which a particle at rest crosses a
            cell of the grid within a substep.

    Raises:
        ValueError: There are no bodies, ``dt`` is not positive, or above :meth:`stable_dt`, or too long for gravity,
            ``damping`` is not from 0 to 1, ``gravity`` is not two finite numbers or has another shape, a tensor is not
            finite, a mass or volume is not positive, or ``backend`` is unknown or not available.
        TypeError: ``grid``, a body or a rule has another type, or a tensor is not dense.

    Examples:
        A drop of gel falls for 10 ms. The gradient of its position with respect to its initial velocity is that time.

        >>> import torch, torchmpm
        >>> gel = torchmpm.Elastic(*torchmpm.lame(young=4e4, poisson=0.3))
        >>> drop = torchmpm.Body(500, gel, mass=0.016, volume=1.6e-5)
        >>> solver = torchmpm.Solver(torchmpm.Grid(128), (drop,), gravity=(0.0, -9.8))
        >>> disc = torchmpm.sampling.disc(torchmpm.sampling.sobol(500, seed=0), centre=(0.5, 0.5), radius=0.05)
        >>> state = torchmpm.ParticleState.at_rest(torch.as_tensor(disc))
        >>> later = solver.step(state, substeps=100)
        >>> print(f"{(later.x - state.x)[..., 1].mean():.5f} m")
        -0.00049 m

        Steps are differentiable in states, actuation and material parameters:

        >>> state.v.requires_grad_().shape
        torch.Size([1, 500, 2])
        >>> solver.step(state, substeps=100).x[..., 0].mean().backward()
        >>> print(f"{state.v.grad[..., 0].sum():.3f} s")
        0.010 s
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
        leave_parent_threads()
        checks.instance("grid", self.grid, Grid)
        checks.instances("bodies", self.bodies, Body)
        if not self.bodies:
            raise ValueError("bodies must hold at least one Body, got none")
        checks.instances("rules", self.rules, VelocityRule)
        for name in ("bodies", "rules"):  # a list could change after the tables of the kernels were built
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if isinstance(self.gravity, Tensor):
            checks.value("gravity", self.gravity)
            if self.gravity.ndim not in (1, 2) or self.gravity.shape[-1] != 2:
                raise ValueError(f"gravity must have shape (2,) or (B, 2), got {tuple(self.gravity.shape)}")
        else:
            checks.pair("gravity", self.gravity)
            object.__setattr__(self, "gravity", tuple(map(float, self.gravity)))
        checks.number("damping", self.damping, least=0.0, most=1.0)
        checks.flag("allow_unstable", self.allow_unstable)
        checks.number("dt", self.dt, above=0.0)
        if self.backend not in BACKENDS:
            raise ValueError(f"backend must be one of {BACKENDS}, got {self.backend!r}")
        if self.backend == "native" and not torch.cuda.is_available() and not provenance():
            raise ValueError(f"backend 'native' {NO_COMPILER}")
        for name, tensor in self.constants.items():
            if tensor.is_floating_point() and tensor.numel():  # a material may have tensors of all kinds
                checks.entries(name, tensor)
        if not self.allow_unstable:
            self._check_stability()
            stability.check_gravity("gravity", self.gravity, self.grid.h, self.dt)

    def _check_stability(self) -> None:
        try:
            limit = self.stable_dt()
        except RuntimeError:
            if not transforming():
                raise
            return  # under torch.func.vmap nothing can depend on the numbers that tensors hold
        if self.dt > limit:
            raise ValueError(
                f"dt must be at most {limit} s for particles of this stiffness and mass to be stable, got {self.dt}; "
                "allow_unstable=True accepts it"
            )

    def __getstate__(self) -> dict[str, Any]:
        """The fields alone: cached tables are built anew in a copy."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def with_constants(self, bodies: tuple[Body, ...], gravity: tuple[float, float] | Tensor) -> "Solver":
        """Return the same solver with other constants, quickly enough for constants that change in every step.

        The checks of the constructor are skipped, that of the largest stable ``dt`` too. Bodies and materials check
        their values when they are made, and :meth:`step` checks the shapes that it reads.

        Args:
            bodies: Bodies with the counts of the present ones.
            gravity: Acceleration (x, y), m/s^2: two numbers, or a tensor of shape (2,) or (B, 2).

        Returns:
            A solver of the same class, with the same values of all other fields.
        """
        solver = object.__new__(type(self))
        for name, value in (self.__getstate__() | {"bodies": bodies, "gravity": gravity}).items():
            object.__setattr__(solver, name, value)
        return solver

    @cached_property
    def constants(self) -> dict[str, Tensor]:
        """Constants of the bodies, and gravity, that are tensors, by names such as ``bodies[0].material.mu``."""
        named = {f"bodies[{k}].{name}": v for k, body in enumerate(self.bodies) for name, v in body.constants().items()}
        return {name: value for name, value in {**named, "gravity": self.gravity}.items() if isinstance(value, Tensor)}

    @cached_property
    def kernels(self) -> Kernels:
        """The tables that the native backend reads."""
        return Kernels(self.grid, self.bodies, self.rules, self.dt, self.damping)

    @property
    def num_particles(self) -> int:
        """N, the number of particles of all bodies."""
        return sum(body.count for body in self.bodies)

    def stable_dt(self, actuation: Value = 0.0) -> float:
        """Return the largest duration of a substep for which small strains of undeformed material do not grow, s.

        It is the least of ``h / sqrt((k + 2 |a|) V / m)`` over all particles, with the stiffness k of the material, the
        actuation a (0 without muscles), the volume V and the mass m. This holds for any arrangement of particles, as
        the velocity gradient C of a particle cannot exceed what the kinetic energy of its nodes allows,
        ``h^2/4 |C|^2 <= sum w |v|^2``. Large strains, and snow that has hardened, are stiffer and may need less.

        Args:
            actuation: Largest actuation of the muscles, Pa; a number or a tensor of shape (), (B,) or (B, count).

        Returns:
            Seconds; infinity if nothing is stiff.

        Raises:
            ValueError: The shapes of a body's values do not go together, or values are not finite or have a wrong sign.
        """
        return stability.stable_dt(self.bodies, self.grid.h, actuation)

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

        Particles outside the window, and particles whose position is not finite, keep their whole state and contribute
        to no derivative; a particle outside moves on once the window reaches it again. A velocity or deformation in the
        window that is not finite spreads through the grid of its simulation. It can also make the derivative with
        respect to a constant that simulations share NaN, even if the loss depends on other simulations alone.

        Args:
            state: The present state of B simulations with the solver's N particles.
            actuation: (B, 2, G, G) muscle stress on the nodes of the window, Pa, for bodies with ``muscle=True``; a
                positive value contracts. ``[:, 0]`` acts along material x and ``[:, 1]`` along material y; the last two
                indices are (i, j), to the right and upwards. ``None`` means no actuation. Actuation makes matter
                stiffer: ``dt`` must not exceed :meth:`stable_dt` of its largest magnitude, which is not checked.
            substeps: Number of substeps, at least 0.
            origin: (B, 2) lower left corner of the window in the world, m; ``None`` stands for (0, 0). A simulation
                whose origin is not finite, or far from its matter, stands still and does not affect the others.
            segment: Substeps between checkpoints when gradients are enabled, see :func:`torchmpm.repeated`. The native
                backend keeps the state at the start of each segment and replays the segment in the backward pass; for
                it ``"auto"`` and ``None`` stand for the longest segments that memory for the replay allows.

        Returns:
            The new state, differentiable with respect to state, actuation, origin, material constants, masses, volumes
            and gravity.

        Raises:
            ValueError: Shapes, dtypes or devices do not fit together, ``substeps`` or ``segment`` is out of range, or
                the native backend was chosen and cannot run this.
            TypeError: ``state``, ``actuation`` or ``origin`` has another type, or a material returns tensors of another
                number, shape or dtype.
            RuntimeError: In the backward pass: one of these tensors was changed in place after the step.
        """
        if self.backend != "eager" and torch.compiler.is_compiling():  # with fullgraph=True; else it runs as it is
            raise ValueError(f"backend {self.backend!r} cannot be traced by torch.compile, use 'eager'")
        leave_parent_threads()
        substeps, segment = checks.whole("substeps", substeps, 0), checks.segment(segment)
        origin = self.check_arguments(state, actuation, origin)
        if substeps == 0 or state.batch_size == 0:
            return state
        if self.runs_native(state, actuation, origin):
            return self.kernels.step(state, actuation, origin, self.gravity, substeps, segment)
        self._try_laws(state)
        scene = self.scene(state, actuation, origin)
        step = partial(substep, boundary=self.boundary)
        if self._reads_scene_alone:
            end = repeated(step, state.components(), substeps, segment=segment, shared=scene)
        else:
            end = repeated(partial(step, scene), state.components(), substeps, segment=segment)
        return ParticleState.from_stack(torch.stack(end))

    def boundary(self, scene: Scene, velocity: Tensor) -> Tensor:
        """Change the velocities of the nodes as the surroundings do in a substep: apply the velocity rules.

        A subclass may add surfaces of other shapes, or surfaces that move; it then runs on the eager backend.

        Args:
            scene: What the substeps of this step share, see :meth:`scene`.
            velocity: (2, B, cells) velocities of the nodes, m/s, in the order of :meth:`torchmpm.Grid.nodes`.

        Returns:
            The new velocities (2, B, cells), m/s.
        """
        return constrain(scene.faces, velocity)

    @property
    def _overridden(self) -> str | None:
        """Which of the methods that the eager backend calls a subclass overrides, if any."""
        own = type(self)
        return next((n for n in ("scene", "boundary") if getattr(own, n) is not getattr(Solver, n)), None)

    def runs_native(self, state: ParticleState, *fields: Tensor | None) -> bool:
        """Whether a step from this state, which also depends on the ``fields`` (B, ...), runs in the native kernels.

        ``"auto"`` chooses them wherever they work, and logs once why they do not. On CUDA they must first agree with
        the eager backend on a small scene, see :func:`kernels_fail`.

        Raises:
            ValueError: The backend is ``"native"`` and cannot run this.
        """
        if self.backend == "eager":
            return False
        reason = self._not_native(state, *fields)
        if self.backend == "native":
            if reason is not None:
                raise ValueError(f"backend 'native' cannot run this: {reason}; use 'eager'")
            return True
        if reason is None and state.device.type == "cuda":
            reason = kernels_fail(state.device, state.dtype)
        elif reason is None:
            try:
                load(state.dtype)
            except ValueError as error:
                reason = str(error)
        if reason is not None:
            warn_eager("the physics", reason)
        return reason is None

    @property
    def _reads_scene_alone(self) -> bool:
        """Whether a substep reads no tensors but those of the scene; custom parts of it may read others."""
        return (
            not self._overridden
            and not torch.compiler.is_compiling()
            and tree.opaque_leaf((self.grid, self.bodies)) is None
        )

    def _not_native(self, state: ParticleState, *fields: Tensor | None) -> str | None:
        """Why the kernels cannot run a step, or ``None`` if they can."""
        if self._overridden:
            return f"it does not call {type(self).__name__}.{self._overridden}"
        if transforming():
            return "transforms of torch.func and traces of make_fx do not go through its kernels"
        given = [t for t in (*vars(state).values(), *fields, *self.constants.values()) if t is not None]
        if tree.has_tangents(given):
            return "it has no forward-mode derivatives"
        for tensor in given:  # a null pointer would kill the process
            if type(tensor).__torch_dispatch__ is not Tensor.__torch_dispatch__:
                return f"its kernels read memory, which a {type(tensor).__name__} may not have"
        return self.kernels.unsupported(state.device)

    def scene(self, state: ParticleState, actuation: Tensor | None, origin: Tensor) -> Scene:
        """Prepare what all substeps of a step share; only the eager backend calls this.

        A subclass may return a changed scene, for example with another friction of its ``faces``; it then runs on the
        eager backend.

        Args:
            state: The state at the start of the step.
            actuation: (B, 2, G, G) muscle stress, Pa, or ``None``, as in :meth:`step`.
            origin: (B, 2) lower left corner of the window in the world, m.
        """
        nodes = self.grid.resolution
        exists = pad(state.Jp.new_ones(nodes, nodes), [PAD] * 4).flatten()[None]
        if actuation is not None:
            actuation = pad(actuation, [PAD] * 4).flatten(2).transpose(0, 1).contiguous()
        gravity = torch.as_tensor(self.gravity, dtype=state.dtype, device=state.device)
        return Scene(
            grid=self.grid,
            bodies=self.bodies,
            dt=self.dt,
            origin=origin,
            mass=per_particle(self.bodies, "mass", state.Jp),
            exists=exists,
            gravity=(self.dt * gravity).reshape(-1, 2).T[..., None] * exists,
            damping=self.damping,
            faces=faces(self.rules, self.grid, origin),
            actuation=actuation,
        )

    def check_state(self, state: ParticleState) -> None:
        """Raise an error unless this is a state of as many particles as the bodies have, and gravity of its batch.

        Raises:
            ValueError: It has another number of particles, or gravity that of another batch.
            TypeError: It has another type.
        """
        checks.instance("state", state, ParticleState)
        if state.num_particles != self.num_particles:
            raise ValueError(f"state has {state.num_particles} particles, the solver's bodies {self.num_particles}")
        batch, gravity = state.batch_size, self.gravity
        if isinstance(gravity, Tensor) and tuple(gravity.shape) not in ((2,), (1, 2), (batch, 2)):
            raise ValueError(f"gravity must have shape (2,) or ({batch}, 2), got {tuple(gravity.shape)}")

    def _try_laws(self, state: ParticleState) -> None:
        """Before the first step, call each custom material once, to see whether it returns what it must.

        With gradients before every step: what a law saves that differentiates its energy is counted by a checkpoint
        around the step, and has to be there again in the replay.
        """
        if torch.is_grad_enabled() or not vars(self).get("_tried"):
            components = [component.detach() for component in state.components()]
            for body, part in slices(self.bodies):
                if type(body.material) not in KINDS:
                    a, b, c, d, Jp = (component[:, part] for component in components[8:])
                    try_law(body.material, (a, b, c, d), Jp)
            vars(self)["_tried"] = True

    def check_arguments(self, state: ParticleState, actuation: Tensor | None, origin: Tensor | None) -> Tensor:
        """Check ``state``, ``actuation`` and ``origin`` of a :meth:`step`; returns the origin (B, 2), m."""
        self.check_state(state)
        batch, nodes = state.batch_size, self.grid.resolution
        field_shape = (batch, 2, nodes, nodes)
        for name, value, shape in (("actuation", actuation, field_shape), ("origin", origin, (batch, 2))):
            if value is None:
                continue
            checks.tensor(name, value)
            if (tuple(value.shape), value.dtype, value.device) != (shape, state.dtype, state.device):
                raise ValueError(
                    f"{name} must be {state.dtype} on {state.device} of shape {shape}, "
                    f"got {value.dtype} on {value.device} of shape {tuple(value.shape)}"
                )
        return state.x.new_zeros(batch, 2) if origin is None else origin


@functools.cache
def kernels_fail(device: torch.device, dtype: torch.dtype = torch.float32) -> str | None:
    """Why the native kernels are not to be used on a device, or ``None``; found out once in a process.

    A disc with muscles that hits the ground, and one so wide that the kernels treat it as they do large bodies, take a
    few substeps with them and with the eager backend. States, and derivatives of a number that depends on all of them,
    must agree.
    """
    if device.type == "cuda" and (reason := unavailable(device)) is not None:
        return reason
    body = Body(2000, VonMises(*lame(young=1e3, poisson=0.3), 20.0), mass=4e-3, volume=1.6e-5, muscle=True)
    ground = VelocityRule("-y", j=(None, 5))
    solver = Solver(Grid(128), (body,), (0.0, -9.8), rules=(ground,), backend="eager")
    like = torch.empty(0, dtype=dtype, device=device)
    found = []
    try:
        with torch.inference_mode(False), torch.enable_grad():
            points = torch.as_tensor(disc(sobol(2000, seed=0), centre=(0.0, 0.14), radius=0.1)).to(like)
            points = torch.stack((points, points * like.new_tensor((4.0, 1.0)))) + like.new_tensor((0.5, 0.0))
            waves = 30.0 * torch.arange(4 * 128**2, device=device).to(like).sin().view(2, 2, 128, 128)
            for step in (partial(solver.kernels.step, gravity=solver.gravity), solver.step):
                x, field = (t.clone().requires_grad_() for t in (points, waves))
                start = replace(ParticleState.at_rest(x), v=torch.full_like(x, -1.0))
                end = step(start, field, origin=like.new_zeros(2, 2), substeps=5)
                loss = end.x.square().sum() + end.v.square().sum() + end.F.square().sum()
                found.append((end.x, end.v, end.F, *torch.autograd.grad(loss, (x, field))))
    except Exception as error:  # whatever is wrong with compiler, driver or card, eager still works
        return f"its kernels were tried on {device}, and failed: {error}"
    names = ("x", "v", "F", "the gradient in x", "the gradient in the field")
    for name, ours, theirs in zip(names, *found, strict=True):
        difference = float((ours - theirs).detach().abs().max() / theirs.detach().abs().max())
        if not difference <= (3e-4 if dtype == torch.float32 else 1e-9):
            return f"its kernels were tried on {device}, and {name} differed by {difference:.1e} from that of eager"
    return None
