"""The kernels of a solver: whether they can run, a step through them with its derivative, and the call into C++."""

import ctypes
import functools
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.boundary import VelocityRule
from torchmpm.checks import Segment
from torchmpm.grid import Grid
from torchmpm.materials.body import Body
from torchmpm.native.cuda.compiler import unavailable
from torchmpm.native.cuda.launcher import CUDA
from torchmpm.native.library import POOL, load, thread_pool
from torchmpm.native.tables import COTANGENTS, KINDS, Inputs, Tables, make_tables, make_values, members, upload
from torchmpm.state import ParticleState

#: A node remembers its rule for each direction in one byte, in which 0 stands for none.
MAX_RULES = 255
#: Addresses within one simulation have 32 bits on CUDA, where a node has at most eight numbers.
MAX_RESOLUTION, MAX_PARTICLES = 16_000, 2**30
#: Tape of one simulation on the CPU, bytes: 49 substeps of 22,000 particles in single precision. Longer steps are cut,
#: alike for any number of threads and simulations, as sums over other pieces would be rounded differently.
TAPE_BYTES = 2**26
#: Particles of a body that the kernels for the CPU take together; a last block that is not full takes as much memory.
LANES = 64
#: A call on the CPU without gradients is not cut into smaller pieces: as many substeps as a control step has.
MIN_SUBSTEPS = 100
#: Share of a GPU's memory that the tape of one simulation may take; as many at once as fit have one.
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
        """All of the solver but the values of its materials."""
        return make_tables(self.grid, self.bodies, self.rules, self.dt, self.damping)

    def values(self, like: Tensor) -> Tensor:
        """The table of values (8, 1 or B, columns) for components like (B, N); kept where all of them are numbers."""
        key = like.dtype, like.device
        if key in self._kept:
            return self._kept[key]
        values = make_values(self.bodies, self.dt, self.grid.h, like)
        numbers = not any(isinstance(v, Tensor) for body in self.bodies for v in body.constants().values())
        if numbers:
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
        given = gravity if isinstance(gravity, Tensor) else upload(tuple(gravity), state.dtype, state.device)
        gravity = given.to(state.Jp).expand(state.batch_size, 2)
        values, shift = self.values(state.Jp), self.grid.node_shift(origin)
        inputs = tree.map(Tensor.contiguous, Inputs(state.stack(), actuation, origin, gravity, values, shift))
        limit = substeps
        if torch.is_grad_enabled():  # a piece keeps its start, and needs a tape of all its substeps later
            inputs, limit = tree.without_inference(inputs), self.tape_limit(inputs.components, segment)
        taped = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs)
        if not taped and not inputs.components.is_cuda:
            # Python hears of Ctrl-C between calls, which take some tenths of a second.
            rounds = math.ceil(state.batch_size / torch.get_num_threads())
            limit = max(MIN_SUBSTEPS, self.tape_limit(inputs.components) // rounds)
        for start in range(0, substeps, limit):
            components = Step.apply(self.tables, min(limit, substeps - start), *inputs[:6])
            inputs = inputs._replace(components=components)
        return ParticleState.from_stack(inputs.components)

    def tape_limit(self, components: Tensor, segment: Segment = "auto") -> int:
        """How many substeps of components (13, B, N) the adjoint can replay at once, at most ``segment``."""
        rows, _, particles = components.shape
        if not components.is_cuda:
            particles = sum(-(-body.count // LANES) * LANES for body in self.bodies)
        substep = components.element_size() * (rows * particles + 3 * self.grid.width**2)
        if components.is_cuda:
            memory = torch.cuda.get_device_properties(components.device).total_memory
            limit = int(CUDA_TAPE_SHARE * memory) // substep
        else:
            limit = TAPE_BYTES // substep
        return max(1, min(limit, segment) if isinstance(segment, int) else limit)


class Step(torch.autograd.Function):
    """Some substeps. Autograd keeps their start; the backward pass replays them onto a tape, then goes back."""

    @staticmethod
    def forward(ctx: Any, tables: Tables, substeps: int, *tensors: Any) -> Tensor:
        """New components (13, B, N), from the tensors of :class:`Inputs`."""
        ctx.tables, ctx.substeps = tables, substeps
        ctx.save_for_backward(*tensors)
        return forward(Inputs(*tensors), tables, substeps)

    @staticmethod
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:
        """Derivatives in the tensors of :class:`Inputs` from that in the new components."""
        tensors, (_, wants_field, _, _, wants_values) = ctx.saved_tensors, ctx.needs_input_grad[2:7]
        tables = ctypes.addressof(ctx.tables)
        found = adjoint(*tensors, result_bar, tables, ctx.substeps, wants_field, wants_values)
        *bars, values_bar = (bar if bar.numel() else None for bar in found)
        if values_bar is not None:
            values_bar = _sum_shared(values_bar, tensors[4], ctx.tables)
        return None, None, *bars, values_bar, None


# An operator, so that torch can take it row by row where a whole Jacobian is asked for (``is_grads_batched=True``).
@torch.library.custom_op(
    "torchmpm::adjoint",
    mutates_args=(),
    schema=(
        "(Tensor components, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift, "
        "Tensor result_bar, int tables, int substeps, bool wants_field, bool wants_values) "
        "-> (Tensor, Tensor, Tensor, Tensor, Tensor)"
    ),
)
def adjoint(*arguments: Any) -> tuple[Tensor, ...]:
    """The derivative of :class:`Step`, from :class:`Inputs` and the address of :class:`Tables`."""
    *tensors, tables, substeps, wants_field, wants_values = arguments
    inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
    return backward(inputs, Tables.from_address(tables), substeps, wants_field, wants_values)


def _no_second_derivative(ctx: Any, *_: Tensor) -> None:
    raise RuntimeError("backend 'native' has no second derivatives: use backend 'eager'")


adjoint.register_autograd(_no_second_derivative)


def forward(inputs: Inputs, tables: Tables, substeps: int) -> Tensor:
    """Components (13, B, N) after some substeps."""
    if inputs.components.is_cuda:
        return CUDA.forward(inputs, tables, substeps)
    result = torch.empty_like(inputs.components)
    call("torchmpm_forward", inputs, tables, substeps, result=result)
    return result


def backward(
    inputs: Inputs, tables: Tables, substeps: int, wants_field: bool, wants_values: bool
) -> tuple[Tensor, ...]:
    """Replay the substeps, then go back; derivatives as :meth:`Inputs.empty_cotangents` lists them."""
    if inputs.components.is_cuda:
        return CUDA.backward(inputs, tables, substeps, wants_field, wants_values)
    bars = inputs.empty_cotangents(wants_field, wants_values)
    wanted = {name: bar for name, bar in zip(COTANGENTS, bars, strict=True) if bar.numel()}
    call("torchmpm_backward", inputs, tables, substeps, **wanted)
    return bars


def _sum_shared(bar: Tensor, values: Tensor, tables: Tables) -> Tensor:
    """Sum derivatives per particle (8, B, N) over the particles and simulations that share a value."""
    if values.shape[1] == 1:
        bar = bar.sum(1, keepdim=True)
    columns = []
    for body in tables.bodies[: tables.num_bodies]:
        part = bar.narrow(2, body.first, body.count)
        columns.append(part if body.varying else part.sum(2, keepdim=True))
    return torch.cat(columns, dim=2)


class Call(ctypes.Structure):
    """The arguments of a call into C++, as ``struct Call`` in ``scene.hpp``."""

    _fields_ = [
        *members(ctypes.c_int64, "batch", "particles", "substeps", "threads"),
        *members(ctypes.c_void_p, *POOL),
        ("tables", ctypes.POINTER(Tables)),
        *members(ctypes.c_void_p, "components", "field", "origin", "shift", "gravity", "values"),
        *members(ctypes.c_int64, "values_batch", "columns"),
        *members(ctypes.c_void_p, "result", "result_bar", *COTANGENTS),
    ]


def call(name: str, inputs: Inputs, tables: Tables, substeps: int, **outputs: Tensor) -> None:
    """Call a function of ``native.cpp``, which writes the ``outputs``."""
    library, (_, batch, particles) = load(inputs.components.dtype), inputs.components.shape
    arguments = Call(
        batch=batch,
        particles=particles,
        substeps=substeps,
        threads=torch.get_num_threads(),
        tables=ctypes.pointer(tables),
        values_batch=inputs.values.shape[1],
        columns=inputs.values.shape[2],
        **thread_pool(),
        **{name: tensor.data_ptr() for name, tensor in (inputs._asdict() | outputs).items() if tensor is not None},
    )
    function, measure = getattr(library, name), getattr(library, f"{name}_bytes")
    measure.restype = ctypes.c_size_t
    with _scratch(measure(ctypes.byref(arguments))) as scratch:
        if function(ctypes.byref(arguments), ctypes.c_void_p(scratch)):
            raise MemoryError("backend 'native' ran out of memory")


#: Scratch memory that no call is using. One buffer is kept, as fresh pages cost a third of a backward pass.
_free_scratch: list[Tensor] = []


@contextmanager
def _scratch(size: int) -> Iterator[int]:
    """Address of ``size`` bytes of aligned memory."""
    try:
        buffer = _free_scratch.pop()
    except IndexError:
        buffer = torch.empty(0, dtype=torch.uint8, device="cpu")
    if buffer.numel() < size + 64:
        del buffer
        buffer = torch.empty(size + 64, dtype=torch.uint8, device="cpu")
    yield (buffer.data_ptr() + 63) // 64 * 64
    if not _free_scratch:
        _free_scratch.append(buffer)
