"""Runs the C++ kernels on tensors."""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from torchmpm.native.cpu.library import POOL, load, thread_pool
from torchmpm.native.tables import tables_of

_REAL = {torch.float32: "float", torch.float64: "double"}
#: Scratch memory up to this size, bytes, is kept for the next call: fresh pages cost a third of a backward pass. It is
#: enough for 190 substeps of 22,000 particles in single precision; longer steps are cut.
KEPT_BYTES = 2**28
_kept: list[Tensor] = []


def _members(kind: Any, *names: str) -> list[tuple[str, Any]]:
    return [(name, kind) for name in names]


class _Body(ctypes.Structure):
    """A :class:`torchmpm.native.tables.BodyTable`, as ``struct BodyTable`` in ``scene.hpp``."""

    _fields_ = [
        *_members(ctypes.c_int64, "first", "count", "kind", "muscle", "varying", "column"),
        *_members(ctypes.c_double, "hardening_low", "hardening_high", "shear_cutoff"),
    ]


class _Rule(ctypes.Structure):
    """A :class:`torchmpm.native.tables.RuleTable`, as ``struct RuleTable`` in ``scene.hpp``."""

    _fields_ = [
        *_members(ctypes.c_int64, "axis", "world", "slot"),
        *_members(ctypes.c_double, "sign", "i_low", "i_high", "j_low", "j_high", "friction"),
    ]


class _Tables(ctypes.Structure):
    """A :class:`torchmpm.native.tables.Tables`, as ``struct Tables`` in ``scene.hpp``."""

    _fields_ = [
        *_members(ctypes.c_int64, "resolution", "num_bodies", "num_rules"),
        *_members(ctypes.c_double, "h", "dt", "margin", "damping", "mass_epsilon", "stretch_floor"),
        ("bodies", ctypes.POINTER(_Body)),
        ("rules", ctypes.POINTER(_Rule)),
    ]


class _Call(ctypes.Structure):
    """The arguments of one call, as ``struct Call`` in ``scene.hpp``."""

    _fields_ = [
        *_members(ctypes.c_int64, "batch", "particles", "substeps", "threads"),
        *_members(ctypes.c_void_p, *POOL),
        ("tables", ctypes.POINTER(_Tables)),
        *_members(ctypes.c_void_p, "planes", "field", "origin", "shift", "gravity", "values"),
        *_members(ctypes.c_int64, "values_batch", "columns"),
        *_members(ctypes.c_void_p, "result", "result_bar", "planes_bar", "field_bar", "origin_bar", "gravity_bar"),
        *_members(ctypes.c_void_p, "values_bar"),
    ]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Tensors of a call; see :func:`torchmpm.native.operator.native_step`."""

    planes: Tensor
    field: Tensor | None
    origin: Tensor
    gravity: Tensor
    values: Tensor
    shift: Tensor


def library_for(dtype: torch.dtype) -> ctypes.CDLL:
    """The kernels for a dtype, see :func:`torchmpm.native.cpu.library.load`."""
    return load(_REAL[dtype])


def forward(inputs: Inputs, handle: int, substeps: int, result: Tensor) -> None:
    """Advance all simulations; writes the new planes to ``result``.

    Raises:
        MemoryError: There was not enough memory.
    """
    _run("forward", inputs, handle, substeps, result=result)


def backward(inputs: Inputs, handle: int, substeps: int, result_bar: Tensor, bars: Sequence[Tensor]) -> None:
    """Adjoint of :func:`forward`; writes to ``bars``, derivatives in planes, field, origin, gravity and values.

    Raises:
        MemoryError: There was not enough memory.
    """
    names = ("planes_bar", "field_bar", "origin_bar", "gravity_bar", "values_bar")
    wanted = {name: bar for name, bar in zip(names, bars, strict=True) if bar.numel()}
    _run("backward", inputs, handle, substeps, result_bar=result_bar, **wanted)


def scratch_bytes(inputs: Inputs, handle: int, substeps: int, **outputs: Tensor) -> int:
    """Bytes of scratch memory that a call asks for; backward if ``outputs`` holds derivatives.

    Args:
        inputs: Tensors of the call; only their sizes count.
        handle: Of the tables of the solver.
        substeps: Number of substeps.
        outputs: Output tensors by their names in the call.
    """
    call = _make_call(inputs, handle, substeps, outputs)
    direction = "backward" if "result_bar" in outputs else "forward"
    return _measure(library_for(inputs.planes.dtype), direction, call)


def _run(direction: str, inputs: Inputs, handle: int, substeps: int, **outputs: Tensor) -> None:
    call, library = _make_call(inputs, handle, substeps, outputs), library_for(inputs.planes.dtype)
    run = getattr(library, f"torchmpm_{direction}")
    with _scratch(_measure(library, direction, call)) as scratch:
        if run(ctypes.byref(call), ctypes.c_void_p(scratch)):
            raise MemoryError("backend 'native' ran out of memory")


def _measure(library: ctypes.CDLL, direction: str, call: _Call) -> int:
    measure = getattr(library, f"torchmpm_{direction}_bytes")
    measure.restype = ctypes.c_size_t
    return int(measure(ctypes.byref(call)))


def _make_call(inputs: Inputs, handle: int, substeps: int, outputs: dict[str, Tensor]) -> _Call:
    batch, particles = inputs.planes.shape[1:]
    tensors = vars(inputs) | outputs
    return _Call(
        batch=batch,
        particles=particles,
        substeps=substeps,
        threads=torch.get_num_threads(),
        tables=ctypes.pointer(_structure(handle)),
        values_batch=inputs.values.shape[1],
        columns=inputs.values.shape[2],
        **thread_pool(),
        **{name: _address(tensor) for name, tensor in tensors.items()},
    )


@functools.cache
def _structure(handle: int) -> _Tables:
    """Tables as the kernels read them."""
    tables = tables_of(handle)
    bodies, rules = [_Body(**asdict(body)) for body in tables.bodies], [_Rule(**asdict(rule)) for rule in tables.rules]
    numbers = {name: value for name, value in vars(tables).items() if name not in ("bodies", "rules")}
    return _Tables(
        num_bodies=len(bodies),
        num_rules=len(rules),
        bodies=(_Body * len(bodies))(*bodies),
        rules=(_Rule * len(rules))(*rules),
        **numbers,
    )


def _address(tensor: Tensor | None) -> int | None:
    assert tensor is None or tensor.is_contiguous()
    return None if tensor is None else tensor.data_ptr()


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
