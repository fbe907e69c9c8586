"""The kernels as operators of torch."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchmpm.native.cpu import call
from torchmpm.native.tables import VALUES, tables_of


@torch.library.custom_op(
    "torchmpm::native_step",
    mutates_args=(),
    schema=(
        "(Tensor planes, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift, "
        "int handle, int substeps) -> Tensor"
    ),
)
def native_step(
    planes: Tensor,
    field: Tensor | None,
    origin: Tensor,
    gravity: Tensor,
    values: Tensor,
    shift: Tensor,
    handle: int,
    substeps: int,
) -> Tensor:
    """Advance all simulations by some substeps.

    Args:
        planes: (13, B, N) components of the state, see :meth:`torchmpm.ParticleState.planes`.
        field: (B, 2, G, G) muscle actuation on the nodes, Pa, or ``None``.
        origin: (B, 2) lower left corner of the window, m.
        gravity: (B, 2) acceleration, m/s^2.
        values: (8, 1 or B, columns) from :func:`torchmpm.native.tables.make_values`.
        shift: (B, 2) int64, nodes between the world's origin and the window's.
        handle: Of the tables, from :func:`torchmpm.native.tables.handle_of`.
        substeps: Number of substeps, at least 1.

    Returns:
        (13, B, N) planes of the new state.
    """
    planes = planes.contiguous()
    result = torch.empty_like(planes)
    inputs = call.Inputs(planes, field, origin, gravity, values, shift)
    call.forward(inputs, handle, substeps, result)
    return result


@native_step.register_kernel("cuda")
def _(*arguments: Any) -> Tensor:
    from torchmpm.native import cuda  # not at the top: it imports Triton

    return cuda.forward(*arguments)


@native_step.register_fake
def _(planes: Tensor, *_: object) -> Tensor:
    return torch.empty_like(planes, memory_format=torch.contiguous_format)


@torch.library.custom_op(
    "torchmpm::native_step_backward",
    mutates_args=(),
    schema=(
        "(Tensor result_bar, Tensor planes, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift, "
        "int handle, int substeps, bool wants_field, bool wants_values) -> (Tensor, Tensor, Tensor, Tensor, Tensor)"
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
    handle: int,
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
        handle: As above.
        substeps: As above.
        wants_field: Whether to compute the derivative in the field.
        wants_values: Whether to compute the derivative in the values.

    Returns:
        Derivatives in planes, field, origin and gravity, in their shapes, and in the values, (8, B, N): one column per
        particle. Those that are not wanted are empty.
    """
    planes, result_bar = planes.contiguous(), result_bar.contiguous()
    bars = _empty_bars(planes, field, origin, gravity, wants_field, wants_values)
    inputs = call.Inputs(planes, field, origin, gravity, values, shift)
    call.backward(inputs, handle, substeps, result_bar, bars)
    return bars


@native_step_backward.register_kernel("cuda")
def _(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    from torchmpm.native import cuda

    return cuda.backward(*arguments)


def _empty_bars(
    planes: Tensor, field: Tensor | None, origin: Tensor, gravity: Tensor, wants_field: bool, wants_values: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Room for the derivatives in planes, field, origin, gravity and values."""
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
    handle: int,
    substeps: int,
    wants_field: bool,
    wants_values: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    return _empty_bars(planes, field, origin, gravity, wants_field, wants_values)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.handle, ctx.substeps = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:
    saved = ctx.saved_tensors
    _, wants_field, wants_origin, wants_gravity, wants_values, *_ = ctx.needs_input_grad
    planes_bar, field_bar, origin_bar, gravity_bar, values_bar = native_step_backward(
        result_bar, *saved, ctx.handle, ctx.substeps, wants_field, wants_values
    )
    return (
        planes_bar,
        field_bar if wants_field else None,
        origin_bar if wants_origin else None,
        gravity_bar if wants_gravity else None,
        _sum_shared(values_bar, saved[4], ctx.handle) if wants_values else None,
        None,
        None,
        None,
    )


def _sum_shared(bar: Tensor, values: Tensor, handle: int) -> Tensor:
    """Sum derivatives per particle (8, B, N) over the particles and simulations that share a value."""
    if values.shape[1] == 1:
        bar = bar.sum(1, keepdim=True)
    columns = []
    for body in tables_of(handle).bodies:
        part = bar[:, :, body.first : body.first + body.count]
        columns.append(part if body.varying else part.sum(2, keepdim=True))
    return torch.cat(columns, dim=2)


def _no_second_derivative(ctx: Any, *_: Tensor) -> None:
    raise RuntimeError("backend 'native' has no second derivatives: use backend 'eager'")


native_step.register_autograd(_backward, setup_context=_setup_context)
native_step_backward.register_autograd(_no_second_derivative)
