"""Entry points of the solver: whether the kernels can run, and a step through them."""

import functools
import importlib.util
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.boundary import VelocityRule, node_shift
from torchmpm.grid import Grid
from torchmpm.materials.body import Body
from torchmpm.native import operator
from torchmpm.native.cpu import call
from torchmpm.native.tables import KINDS, make_tables, make_values, upload
from torchmpm.rollout import Segment
from torchmpm.state import ParticleState

#: A node remembers its rule for each direction in one byte, in which 0 stands for none.
MAX_RULES = 255
#: Addresses within one simulation have 32 bits on CUDA, where a node has at most eight numbers.
MAX_RESOLUTION, MAX_PARTICLES = 16_000, 2**30
#: The tape on CUDA takes no more than this, bytes.
CUDA_TAPE_BYTES = 2**31


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
            missing = triton_missing(os.environ.get("CC"), os.environ.get("PATH"))
            if missing is not None:
                return missing
            if torch.get_deterministic_debug_mode() == 2:  # not allowed, rather than warned of
                return "on CUDA it adds in no fixed order, which torch.use_deterministic_algorithms(True) forbids"
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
    def handle(self) -> int:
        """Handle of the tables, see :func:`torchmpm.native.tables.make_tables`."""
        return make_tables(self.grid, self.bodies, self.rules, self.dt, self.damping)

    def values(self, like: Tensor) -> Tensor:
        """The table of values (8, 1 or B, columns) for planes like (B, N); kept where all of them are numbers."""
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
        planes = state.stack()
        if torch.is_grad_enabled():
            tensors = planes, actuation, origin, gravity, values, shift
            planes, actuation, origin, gravity, values, shift = tree.without_inference(tensors)
        # With gradients a call keeps its start and needs a tape of all its substeps later, whose size must be bounded.
        limit = self.tape_limit(planes, segment) if torch.is_grad_enabled() else substeps
        for start in range(0, substeps, limit):
            length = min(limit, substeps - start)
            planes = operator.native_step(planes, actuation, origin, gravity, values, shift, self.handle, length)
        return ParticleState.from_stack(planes)

    def tape_limit(self, planes: Tensor, segment: Segment = "auto") -> int:
        """How many substeps of planes (13, B, N) the adjoint can replay at once, at most ``segment``."""
        if planes.is_cuda:
            limit = CUDA_TAPE_BYTES // (planes.element_size() * planes.numel())
        else:
            limit = call.KEPT_BYTES // (self.tape_bytes(planes) * min(planes.shape[1], torch.get_num_threads()))
        return max(1, min(limit, segment) if isinstance(segment, int) else limit)

    def tape_bytes(self, planes: Tensor, share: float = 1.0) -> int:
        """Bytes of a substep of one simulation on the tape on the CPU, with this share of the nodes near particles."""
        rows, _, particles = planes.shape
        return planes.element_size() * (rows * particles + int(share * 3 * self.grid.width**2))


@functools.cache
def triton_missing(compiler: str | None, path: str | None) -> str | None:
    """Why Triton cannot work, or ``None`` if it can, with $CC and $PATH as given."""
    if importlib.util.find_spec("triton") is None:
        return "on CUDA it needs Triton, which is not installed (torch's builds for CUDA bring it along)"
    if compiler is None and not any(shutil.which(name, path=path) for name in ("gcc", "clang")):
        return "on CUDA it needs a C compiler for Triton ($CC, gcc or clang), found none"
    return None
