"""Runs the CUDA kernels on the CPU: see ``imitation/cuda_imitation.hpp``."""

import ctypes
import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchmpm.grid import PAD
from torchmpm.native import cuda
from torchmpm.native.cpu.library import build
from torchmpm.native.cuda.arguments import COUNTERS, Arguments, Kernel
from torchmpm.native.tables import Cotangents, Inputs, Tables, tables_of

HERE = Path(__file__).with_name("imitation")
KERNELS = Path(cuda.__file__).parent
COMMON = KERNELS.parent / "common"
#: Threads of a block, and particles that each of them keeps.
THREADS, PER_THREAD = 32, 2
COTANGENTS = ("components_bar", "field_bar", "origin_bar", "gravity_bar", "values_bar")


class Outcome(Exception):
    """A launch that did not end well: threads at different barriers, waiting for ever, or a write out of bounds."""


@dataclass(frozen=True)
class Machine:
    """How kernels are launched, and what is broken about it."""

    shared: bool = True  # nodes in shared memory
    blocks: int = 2  # blocks in all, or for each robot where nodes are in global memory
    teams: int = 1  # robots at a time where nodes are in global memory
    window: tuple[int, int] = (10**6, 10**6)  # nodes at most
    seed: int = 0
    missing_barrier: int = -1
    plain_atomic: int = -1


@functools.cache
def library(real: str, shared: bool) -> ctypes.CDLL:
    """The kernels for a dtype and a kind of memory."""
    folders = (KERNELS, COMMON, HERE)
    sources = sorted(file for folder in folders for file in folder.iterdir() if file.suffix in (".cu", ".cuh", ".hpp"))
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sources)).hexdigest()[:16]
    macros = kernel(False, real, shared).macros | {"DIGEST": digest}
    options = (*(f"-D{name}={value}" for name, value in macros.items()), *(f"-I{folder}" for folder in folders))
    return build(HERE / "imitation.cpp", "-O1", *options)


def kernel(adjoint: bool, real: str, shared: bool) -> Kernel:
    """A kernel for all materials, with muscles."""
    return Kernel(adjoint, shared, real, THREADS, PER_THREAD, kinds=7, muscles=True)


def forward(inputs: Inputs, handle: int, substeps: int, machine: Machine, status: Tensor | None = None) -> Tensor:
    """Components after some substeps; ``status`` as in ``arguments.cuh``."""
    result = torch.full_like(inputs.components, torch.nan)
    _launch(inputs, handle, substeps, machine, status, result=result)
    return result


def adjoint(
    inputs: Inputs, handle: int, substeps: int, machine: Machine, status: Tensor | None = None, wants: bool = True
) -> Cotangents:
    """Derivatives in components, field, origin, gravity and values; the last with ``wants``."""
    bars = tuple(bar.fill_(torch.nan) for bar in inputs.empty_cotangents(wants, wants))
    wanted = {name: bar for name, bar in zip(COTANGENTS, bars, strict=True) if bar.numel()}
    _launch(inputs, handle, substeps, machine, status, **wanted)
    return bars


def _launch(
    inputs: Inputs, handle: int, substeps: int, machine: Machine, status: Tensor | None, **outputs: Tensor
) -> None:
    tables, (_, batch, particles) = tables_of(handle), inputs.components.shape
    real = "double" if inputs.components.dtype == torch.float64 else "float"
    program = kernel("result" not in outputs, real, machine.shared)
    width = tables.resolution + 2 * PAD
    rows, columns = (min(n, width) if machine.shared else width for n in machine.window)
    team = 1 if machine.shared else machine.blocks
    teams = machine.blocks if machine.shared else machine.teams
    if program.shared and status is None:
        status = torch.empty(batch, dtype=torch.int32)
    if inputs.field is None:
        inputs = inputs._replace(field=inputs.components.new_zeros(batch, 2, tables.resolution, tables.resolution))
    scratch_bytes = program.scratch_bytes(rows, columns, tables.resolution, particles, substeps)
    scratch = torch.full((teams * scratch_bytes + 256,), 0xCB, dtype=torch.uint8)  # what is not written is noticed
    scratch[-256:] = 7
    counters = torch.zeros(teams * COUNTERS, dtype=torch.int32)
    tensors = inputs._asdict() | outputs | {"status": status, "counters": counters, "scratch": scratch}
    given = Arguments(
        batch=batch, particles=particles, substeps=substeps, resolution=tables.resolution,
        num_bodies=tables.num_bodies, num_rules=tables.num_rules, rows=rows, columns=columns, team=team,
        values_batch=inputs.values.shape[1], value_columns=inputs.values.shape[2], scratch_bytes=scratch_bytes,
        h=tables.h, dt=tables.dt, margin=tables.margin, extent=tables.extent, damping=tables.damping,
        mass_epsilon=tables.mass_epsilon, stretch_floor=tables.stretch_floor,
        bodies=_address(tables, "bodies"), rules=_address(tables, "rules"),
        **{name: tensor.data_ptr() for name, tensor in tensors.items() if tensor is not None},
    )  # fmt: skip
    size = program.shared_bytes(rows, columns, tables.num_bodies, tables.num_rules)
    outcome = library(real, machine.shared).launch(
        ctypes.byref(given), program.adjoint, team * teams, ctypes.c_size_t(size), ctypes.c_uint64(machine.seed),
        machine.missing_barrier, machine.plain_atomic,
    )  # fmt: skip
    if outcome or not (scratch[-256:] == 7).all():
        raise Outcome(("scratch memory", "threads diverged", "threads wait for ever", "shared memory")[outcome])


def _address(tables: Tables, name: str) -> int | None:
    return ctypes.cast(getattr(tables, name), ctypes.c_void_p).value
