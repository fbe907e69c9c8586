"""The kernels as operators of torch."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from torchmpm.native.library import Call, load, thread_pool
from torchmpm.native.pack import VALUES, body_widths
from torchmpm.rollout import Segment

_REAL = {torch.float32: "float", torch.float64: "double"}
#: Scratch memory up to this size, bytes, is kept for the next call: fresh pages cost a third of a backward pass. It is
#: enough for 190 substeps of 22,000 particles in single precision; longer steps are cut.
KEPT_BYTES = 2**28
#: The tape on CUDA takes no more than this, bytes.
CUDA_TAPE_BYTES = 2**31
_kept: list[Tensor] = []


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


def tape_limit(planes: Tensor, width: int, segment: Segment = "auto") -> int:
    """How many substeps the adjoint can replay at once within :data:`KEPT_BYTES`, or :data:`CUDA_TAPE_BYTES`.

    Args:
        planes: (13, B, N).
        width: Nodes per axis with their padding.
        segment: Not more than so many, if it is a number.
    """
    rows, batch, particles = planes.shape
    if planes.is_cuda:
        limit = CUDA_TAPE_BYTES // (planes.element_size() * rows * particles * batch)
    else:
        substep = planes.element_size() * (rows * particles + 3 * width**2) * min(batch, torch.get_num_threads())
        limit = KEPT_BYTES // substep
    return max(1, min(limit, segment) if isinstance(segment, int) else limit)


def library_for(dtype: torch.dtype) -> ctypes.CDLL:
    """The kernels for a dtype, see :func:`torchmpm.native.library.load`."""
    return load(_REAL[dtype])


def _run(name: str, dtype: torch.dtype, call: Call) -> None:
    """Call one of the kernels.

    Raises:
        MemoryError: There was not enough memory.
    """
    library, reference = library_for(dtype), ctypes.byref(call)
    measure = getattr(library, f"torchmpm_{name}_bytes")
    measure.restype = ctypes.c_size_t
    with _scratch(measure(reference)) as address:
        if getattr(library, f"torchmpm_{name}")(reference, ctypes.c_void_p(address)):
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
        description: float64 on the CPU, from :func:`torchmpm.native.pack.description`.
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


@native_step.register_kernel("cuda")
def _(*arguments: Any) -> Tensor:
    from torchmpm.native import cuda  # not at the top: it imports Triton

    return cuda.forward(*arguments)


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
        **thread_pool(),
    )


@native_step.register_fake
def _(planes: Tensor, *_: object) -> Tensor:
    return torch.empty_like(planes, memory_format=torch.contiguous_format)


@torch.library.custom_op(
    "torchmpm::native_step_backward",
    mutates_args=(),
    schema=(
        "(Tensor result_bar, Tensor planes, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift, "
        "Tensor description, int substeps, bool wants_field, bool wants_values) "
        "-> (Tensor, Tensor, Tensor, Tensor, Tensor)"
    ),
)
def native_step_backward(
    result_bar: Tensor,
    planes: Tensor,
    field: Tensor | None,
    origin: Tensor,
    gravity: Tensor,
    values: Tensor,
    shift: Tensor,
    description: Tensor,
    substeps: int,
    wants_field: bool,
    wants_values: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Adjoint of :func:`native_step`: replays its substeps, then goes back through them.

    Args:
        result_bar: (13, B, N) derivative of a loss in the result.
        planes: As for :func:`native_step`, and all that follow.
        field: As above.
        origin: As above.
        gravity: As above.
        values: As above.
        shift: As above.
        description: As above.
        substeps: As above.
        wants_field: Whether the derivative in the field is wanted.
        wants_values: Whether the derivative in the values is wanted.

    Returns:
        Derivatives in planes, field, origin and gravity, in their shapes, and in the values, (8, B, N): one column per
        particle. Those that are not wanted are empty.
    """
    planes, result_bar = planes.contiguous(), result_bar.contiguous()
    outputs = _backward_outputs(planes, field, origin, gravity, wants_field, wants_values)
    planes_bar, field_bar, origin_bar, gravity_bar, values_bar = outputs
    call = _call(planes, field, origin, gravity, values, shift, description, substeps)
    call.result_bar, call.planes_bar = _address(result_bar), _address(planes_bar)
    call.origin_bar, call.gravity_bar = _address(origin_bar), _address(gravity_bar)
    call.field_bar = _address(field_bar) if wants_field else None
    call.values_bar = _address(values_bar) if wants_values else None
    _run("backward", planes.dtype, call)
    return outputs


@native_step_backward.register_kernel("cuda")
def _(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    from torchmpm.native import cuda

    return cuda.backward(*arguments)


def _backward_outputs(
    planes: Tensor, field: Tensor | None, origin: Tensor, gravity: Tensor, wants_field: bool, wants_values: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    nothing = planes.new_empty(0)
    return (
        torch.empty_like(planes, memory_format=torch.contiguous_format),
        torch.empty_like(field) if wants_field and field is not None else nothing,
        torch.empty_like(origin),
        torch.empty_like(gravity),
        planes.new_empty(VALUES, *planes.shape[1:]) if wants_values else nothing.clone(),
    )


@native_step_backward.register_fake
def _(
    result_bar: Tensor,
    planes: Tensor,
    field: Tensor | None,
    origin: Tensor,
    gravity: Tensor,
    values: Tensor,
    shift: Tensor,
    description: Tensor,
    substeps: int,
    wants_field: bool,
    wants_values: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    return _backward_outputs(planes, field, origin, gravity, wants_field, wants_values)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, substeps = inputs
    ctx.save_for_backward(*tensors)
    ctx.substeps = substeps


def _backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:
    saved = ctx.saved_tensors
    values, description = saved[4], saved[6]
    _, wants_field, wants_origin, wants_gravity, wants_values, *_ = ctx.needs_input_grad
    planes_bar, field_bar, origin_bar, gravity_bar, values_bar = native_step_backward(
        result_bar, *saved, ctx.substeps, wants_field, wants_values
    )
    return (
        planes_bar,
        field_bar if wants_field else None,
        origin_bar if wants_origin else None,
        gravity_bar if wants_gravity else None,
        _fold(values_bar, values, description) if wants_values else None,
        None,
        None,
        None,
    )


def _fold(bar: Tensor, values: Tensor, description: Tensor) -> Tensor:
    """Sum derivatives per particle (8, B, N) over the particles and simulations that share a value."""
    if values.shape[1] == 1:
        bar = bar.sum(1, keepdim=True)
    columns, start = [], 0
    for count, width in body_widths(description):
        part = bar[:, :, start : start + count]
        columns.append(part if width == count else part.sum(2, keepdim=True))
        start += count
    return torch.cat(columns, dim=2)


def _no_second_derivative(ctx: Any, *_: Tensor) -> None:
    raise RuntimeError("backend 'native' has no second derivatives: use backend 'eager'")


native_step.register_autograd(_backward, setup_context=_setup_context)
native_step_backward.register_autograd(_no_second_derivative)
