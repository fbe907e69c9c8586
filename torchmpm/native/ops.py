"""The kernels as operators of torch."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from torchmpm.native.library import Call, load

_REAL = {torch.float32: "float", torch.float64: "double"}
#: Scratch memory up to this size, bytes, is kept for the next call: fresh pages cost a third of a backward pass.
KEPT_BYTES = 2**28
_kept: list[Tensor] = []


@contextmanager
def _scratch(size: int) -> Iterator[int]:
    """Address of ``size`` bytes of aligned memory."""
    try:
        buffer = _kept.pop()
    except IndexError:
        buffer = torch.empty(0, dtype=torch.uint8)
    if buffer.numel() < size + 64:
        del buffer
        buffer = torch.empty(size + 64, dtype=torch.uint8)
    yield (buffer.data_ptr() + 63) // 64 * 64
    if buffer.numel() <= KEPT_BYTES and not _kept:
        _kept.append(buffer)


def library_for(dtype: torch.dtype) -> ctypes.CDLL:
    """The kernels for a dtype, see :func:`torchmpm.native.library.load`."""
    return load(_REAL[dtype])


def _run(name: str, dtype: torch.dtype, call: Call) -> None:
    """Call one of the kernels.

    Raises:
        MemoryError: There was not enough memory.
    """
    library = library_for(dtype)
    measure, function = getattr(library, f"torchmpm_{name}_bytes"), getattr(library, f"torchmpm_{name}")
    measure.restype = ctypes.c_size_t
    with _scratch(measure(ctypes.byref(call))) as address:
        if function(ctypes.byref(call), ctypes.c_void_p(address)):
            raise MemoryError("backend 'native' ran out of memory")


def _address(tensor: Tensor | None) -> int | None:
    assert tensor is None or tensor.is_contiguous()
    return None if tensor is None else tensor.data_ptr()


@torch.library.custom_op(
    "torchmpm::native_step",
    mutates_args=(),
    schema=(
        "(Tensor planes, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift, "
        "Tensor description, int substeps) -> Tensor"
    ),
)
def native_step(
    planes: Tensor,
    field: Tensor | None,
    origin: Tensor,
    gravity: Tensor,
    values: Tensor,
    shift: Tensor,
    description: Tensor,
    substeps: int,
) -> Tensor:
    """Advance all simulations by some substeps.

    Args:
        planes: (13, B, N) components of the state, see :meth:`torchmpm.ParticleState.planes`.
        field: (B, 2, G, G) muscle actuation on the nodes, Pa, or ``None``.
        origin: (B, 2) lower left corner of the window, m.
        gravity: (B, 2) acceleration, m/s^2.
        values: (8, 1 or B, columns) from :func:`torchmpm.native.pack.values`.
        shift: (B, 2) int64, nodes between the world's origin and the window's.
        description: float64, from :func:`torchmpm.native.pack.description`.
        substeps: Number of substeps, at least 1.

    Returns:
        (13, B, N) planes of the new state.
    """
    planes = planes.contiguous()
    result = torch.empty_like(planes)
    call = _call(planes, field, origin, gravity, values, shift, description, substeps)
    call.result = _address(result)
    _run("forward", planes.dtype, call)
    return result


def _call(
    planes: Tensor,
    field: Tensor | None,
    origin: Tensor,
    gravity: Tensor,
    values: Tensor,
    shift: Tensor,
    description: Tensor,
    substeps: int,
) -> Call:
    return Call(
        batch=planes.shape[1],
        particles=planes.shape[2],
        substeps=substeps,
        threads=torch.get_num_threads(),
        description=_address(description),
        planes=_address(planes),
        field=_address(field),
        origin=_address(origin),
        shift=_address(shift),
        gravity=_address(gravity),
        values=_address(values),
        values_batch=values.shape[1],
        columns=values.shape[2],
    )


@native_step.register_fake
def _(planes: Tensor, *_: object) -> Tensor:
    return torch.empty_like(planes, memory_format=torch.contiguous_format)
