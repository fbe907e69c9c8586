"""The kernels of a solver: whether they can run, a step through them, and the operators of torch that it calls."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.boundary import VelocityRule, node_shift
from torchmpm.grid import Grid
from torchmpm.materials.body import Body
from torchmpm.native.cpu import call
from torchmpm.native.cuda import launcher, unavailable
from torchmpm.native.tables import (
    KINDS,
    Cotangents,
    Inputs,
    Tables,
    bodies_of,
    make_tables,
    make_values,
    tables_of,
    upload,
)
from torchmpm.rollout import Segment
from torchmpm.state import ParticleState

#: A node remembers its rule for each direction in one byte, in which 0 stands for none.
MAX_RULES = 255
#: Addresses within one simulation have 32 bits on CUDA, where a node has at most eight numbers.
MAX_RESOLUTION, MAX_PARTICLES = 16_000, 2**30
#: Share of a GPU's memory that the tape of one simulation may take; as many simulations at once as fit have one.
CUDA_TAPE_SHARE = 1 / 16


@dataclass(frozen=True, eq=False)
class Kernels:
    """Native kernels of one solver, with the same fields; builds its tables once."""

    grid: Grid
    bodies: tuple[Body, ...]
    rules: tuple[VelocityRule, ...]
    dt: float
    damping: float
    _kept: dict[tuple[torch.dtype, torch.device], Tensor] = field(default_factory=dict, init=False, repr=False)

    def unsupported(self, device: torch.device) -> str | None:
        """Why the kernels cannot run on a device, or ``None`` if they can."""
        if device.type not in ("cpu", "cuda"):
            return f"its kernels run on the CPU and on CUDA, the state is on {device}"
        if device.type == "cuda":
            missing = unavailable(device)
            if missing is not None:
                return missing
            if torch.get_deterministic_debug_mode() == 2 and torch.is_grad_enabled():  # not allowed, or warned of
                return "gradients on CUDA add in no fixed order, which torch.use_deterministic_algorithms(True) forbids"
        return self._unsupported

    @functools.cached_property
    def _unsupported(self) -> str | None:
        if type(self.grid) is not Grid:
            return f"its kernels support torchmpm.Grid itself, the grid is a {type(self.grid).__name__}"
        for body in self.bodies:
            if type(body.material) not in KINDS:
                names = ", ".join(kind.__name__ for kind in KINDS)
                return f"its kernels support the materials {names}, a body has {type(body.material).__name__}"
        if len(self.rules) > MAX_RULES:
            return f"its kernels take at most {MAX_RULES} velocity rules, got {len(self.rules)}"
        if self.grid.resolution > MAX_RESOLUTION:
            return f"its kernels take at most {MAX_RESOLUTION:,} nodes per axis, got {self.grid.resolution:,}"
        particles = sum(body.count for body in self.bodies)
        if particles > MAX_PARTICLES:
            return f"its kernels take at most {MAX_PARTICLES:,} particles per simulation, got {particles:,}"
        return None

    @functools.cached_property
    def tables(self) -> Tables:
        """All but the values, see :func:`torchmpm.native.tables.make_tables`."""
        return make_tables(self.grid, self.bodies, self.rules, self.dt, self.damping)

    def values(self, like: Tensor) -> Tensor:
        """The table of values (8, 1 or B, columns) for components like (B, N); kept where all of them are numbers."""
        key = like.dtype, like.device
        if key in self._kept:
            return self._kept[key]
        values = make_values(self.bodies, self.dt, self.grid.h, like)
        numbers = not any(isinstance(v, Tensor) for body in self.bodies for v in body.constants().values())
        if numbers and type(values) is Tensor:  # fake tensors of a trace must not be kept
            with torch.inference_mode(False):  # a tensor made in inference mode could not serve gradients later
                self._kept[key] = values = values.clone()
        return values

    def step(
        self,
        state: ParticleState,
        actuation: Tensor | None,
        origin: Tensor,
        gravity: Sequence[float] | Tensor,
        substeps: int,
        segment: Segment = "auto",
    ) -> ParticleState:
        """Advance a state (B, N) whose arguments were checked; see :meth:`torchmpm.Solver.step`."""
        origin = origin.contiguous()
        actuation = None if actuation is None else actuation.contiguous()
        given = gravity if isinstance(gravity, Tensor) else upload(tuple(gravity), state.dtype, state.device)
        gravity = given.to(state.Jp).expand(state.batch_size, 2).contiguous()
        values, shift = self.values(state.Jp), node_shift(self.grid, origin)
        components = state.stack()
        if torch.is_grad_enabled():
            tensors = components, actuation, origin, gravity, values, shift
            components, actuation, origin, gravity, values, shift = tree.without_inference(tensors)
        # With gradients a call keeps its start and needs a tape of all its substeps later, whose size must be bounded.
        limit = self.tape_limit(components, segment) if torch.is_grad_enabled() else substeps
        for start in range(0, substeps, limit):
            length = min(limit, substeps - start)
            components = native_step(components, actuation, origin, gravity, values, shift, self.tables.handle, length)
        return ParticleState.from_stack(components)

    def tape_limit(self, components: Tensor, segment: Segment = "auto") -> int:
        """How many substeps of components (13, B, N) the adjoint can replay at once, at most ``segment``."""
        rows, batch, particles = components.shape
        substep = components.element_size() * (rows * particles + 3 * self.grid.width**2)
        if components.is_cuda:
            memory = torch.cuda.get_device_properties(components.device).total_memory
            limit = int(CUDA_TAPE_SHARE * memory) // substep
        else:
            limit = call.KEPT_BYTES // (substep * min(batch, torch.get_num_threads()))
        return max(1, min(limit, segment) if isinstance(segment, int) else limit)


_INPUTS = "Tensor components, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift"
_NUMBERS = "int handle, int substeps"


@torch.library.custom_op("torchmpm::native_step", mutates_args=(), schema=f"({_INPUTS}, {_NUMBERS}) -> Tensor")
def native_step(*arguments: Any) -> Tensor:
    """Components (13, B, N) after some substeps, from the tensors of Inputs, the handle of Tables, and their number."""
    *tensors, handle, substeps = arguments
    inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
    result = torch.empty_like(inputs.components)
    call.run(inputs, handle, substeps, result=result)
    return result


@torch.library.custom_op(
    "torchmpm::native_step_backward",
    mutates_args=(),
    schema=(
        f"({_INPUTS}, Tensor result_bar, {_NUMBERS}, bool wants_field, bool wants_values) "
        "-> (Tensor, Tensor, Tensor, Tensor, Tensor)"
    ),
)
def native_step_backward(*arguments: Any) -> Cotangents:
    """Replay the substeps, then go back.

    The arguments are tensors, handle, substeps, and whether to compute derivatives in the field and in the values.
    """
    *tensors, handle, substeps, wants_field, wants_values = arguments
    inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
    cotangents = inputs.empty_cotangents(wants_field, wants_values)
    wanted = {n: bar for n, bar in zip(call.COTANGENTS, cotangents, strict=True) if bar.numel()}
    call.run(inputs, handle, substeps, **wanted)
    return cotangents


native_step.register_kernel("cuda")(launcher.forward)
native_step_backward.register_kernel("cuda")(launcher.backward)


@native_step.register_fake
def _(components: Tensor, *_: object) -> Tensor:
    return torch.empty_like(components, memory_format=torch.contiguous_format)


@native_step_backward.register_fake
def _(*arguments: Any) -> Cotangents:
    *tensors, _handle, _substeps, wants_field, wants_values = arguments
    return Inputs(*tensors).empty_cotangents(wants_field, wants_values)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.handle, ctx.substeps = inputs
    ctx.tables = tables_of(ctx.handle)  # the solver may be gone when the backward pass needs them
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:
    saved, wanted = ctx.saved_tensors, ctx.needs_input_grad[:5]
    wants_field, wants_values = wanted[1], wanted[4]
    *found, values_bar = native_step_backward(*saved, result_bar, ctx.handle, ctx.substeps, wants_field, wants_values)
    found.append(_sum_shared(values_bar, saved[4], ctx.handle) if wants_values else None)
    return (*(bar if wants else None for bar, wants in zip(found, wanted, strict=True)), None, None, None)


def _sum_shared(bar: Tensor, values: Tensor, handle: int) -> Tensor:
    """Sum derivatives per particle (8, B, N) over the particles and simulations that share a value."""
    if values.shape[1] == 1:
        bar = bar.sum(1, keepdim=True)
    columns = []
    for body in bodies_of(handle):
        part = bar[:, :, body.first : body.first + body.count]
        columns.append(part if body.varying else part.sum(2, keepdim=True))
    return torch.cat(columns, dim=2)


def _no_second_derivative(ctx: Any, *_: Tensor) -> None:
    raise RuntimeError("backend 'native' has no second derivatives: use backend 'eager'")


native_step.register_autograd(_backward, setup_context=_setup_context)
native_step_backward.register_autograd(_no_second_derivative)
