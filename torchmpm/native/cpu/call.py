"""Runs the C++ kernels on tensors."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from torchmpm.native.cpu.library import POOL, load, thread_pool
from torchmpm.native.tables import Inputs, Tables, tables_of

#: Scratch memory up to this size, bytes, is kept for the next call, as fresh pages cost a third of a backward pass.
#: It is enough for 190 substeps of one simulation of 22,000 particles in single precision; longer steps are cut.
#: Simulations that run at the same time share it.
KEPT_BYTES = 2**28
_kept: list[Tensor] = []
#: Derivatives that the adjoint writes.
COTANGENTS = ("components_bar", "field_bar", "origin_bar", "gravity_bar", "values_bar")


class _Call(ctypes.Structure):
    """The arguments of one call, as ``struct Call`` in ``scene.hpp``."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("batch", "particles", "substeps", "threads")),
        *((name, ctypes.c_void_p) for name in POOL),
        ("tables", ctypes.POINTER(Tables)),
        *((name, ctypes.c_void_p) for name in ("components", "field", "origin", "shift", "gravity", "values")),
        *((name, ctypes.c_int64) for name in ("values_batch", "columns")),
        *((name, ctypes.c_void_p) for name in ("result", "result_bar", *COTANGENTS)),
    ]


def run(inputs: Inputs, handle: int, substeps: int, **outputs: Tensor) -> None:
    """Advance all simulations and write ``result``, or go back and write some of :data:`COTANGENTS`.

    All tensors are contiguous.
    """
    name = "torchmpm_forward" if "result" in outputs else "torchmpm_backward"
    library, (_, batch, particles) = load(inputs.components.dtype), inputs.components.shape
    call = _Call(
        batch=batch,
        particles=particles,
        substeps=substeps,
        threads=torch.get_num_threads(),
        tables=ctypes.pointer(tables_of(handle)),
        values_batch=inputs.values.shape[1],
        columns=inputs.values.shape[2],
        **thread_pool(),
        **{name: tensor.data_ptr() for name, tensor in (inputs._asdict() | outputs).items() if tensor is not None},
    )
    function, measure = getattr(library, name), getattr(library, f"{name}_bytes")
    measure.restype = ctypes.c_size_t
    with _scratch(measure(ctypes.byref(call))) as scratch:
        if function(ctypes.byref(call), ctypes.c_void_p(scratch)):
            raise MemoryError("backend 'native' ran out of memory")


@contextmanager
def _scratch(size: int) -> Iterator[int]:
    """Address of ``size`` bytes of aligned memory."""
    try:
        buffer = _kept.pop()
    except IndexError:
        buffer = torch.empty(0, dtype=torch.uint8, device="cpu")
    if buffer.numel() < size + 64:
        del buffer
        buffer = torch.empty(size + 64, dtype=torch.uint8, device="cpu")
    yield (buffer.data_ptr() + 63) // 64 * 64
    if buffer.numel() <= KEPT_BYTES and not _kept:
        _kept.append(buffer)
