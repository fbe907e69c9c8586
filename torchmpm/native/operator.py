"""The kernels as operators of torch with an adjoint, for tensors on the CPU and on CUDA."""

from typing import Any

import torch
from torch import Tensor

from torchmpm import tree
from torchmpm.native.cpu import call
from torchmpm.native.tables import Bars, Inputs, bodies_of

_INPUTS = "Tensor planes, Tensor? field, Tensor origin, Tensor gravity, Tensor values, Tensor shift"
_NUMBERS = "int handle, int substeps"


@torch.library.custom_op("torchmpm::native_step", mutates_args=(), schema=f"({_INPUTS}, {_NUMBERS}) -> Tensor")
def native_step(*arguments: Any) -> Tensor:
    """Planes (13, B, N) after some substeps, from the tensors of Inputs, a handle of make_tables, and their number."""
    *tensors, handle, substeps = arguments
    inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
    result = torch.empty_like(inputs.planes)
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
def native_step_backward(*arguments: Any) -> Bars:
    """Replay the substeps, then go back.

    The arguments are tensors, handle, substeps, and whether to compute derivatives in the field and in the values.
    """
    *tensors, handle, substeps, wants_field, wants_values = arguments
    inputs = tree.map(Tensor.contiguous, Inputs(*tensors))
    bars = inputs.empty_bars(wants_field, wants_values)
    call.run(inputs, handle, substeps, **{n: bar for n, bar in zip(call.BARS, bars, strict=True) if bar.numel()})
    return bars


@native_step.register_kernel("cuda")
def _(*arguments: Any) -> Tensor:
    from torchmpm.native import cuda  # not at the top: it imports Triton

    return cuda.forward(*arguments)


@native_step_backward.register_kernel("cuda")
def _(*arguments: Any) -> Bars:
    from torchmpm.native import cuda

    return cuda.backward(*arguments)


@native_step.register_fake
def _(planes: Tensor, *_: object) -> Tensor:
    return torch.empty_like(planes, memory_format=torch.contiguous_format)


@native_step_backward.register_fake
def _(*arguments: Any) -> Bars:
    *tensors, _handle, _substeps, wants_field, wants_values = arguments
    return Inputs(*tensors).empty_bars(wants_field, wants_values)


def _setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.handle, ctx.substeps = inputs
    ctx.save_for_backward(*tensors)


def _backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:
    saved, wanted = ctx.saved_tensors, ctx.needs_input_grad[:5]
    wants_field, wants_values = wanted[1], wanted[4]
    *bars, values_bar = native_step_backward(*saved, result_bar, ctx.handle, ctx.substeps, wants_field, wants_values)
    bars.append(_sum_shared(values_bar, saved[4], ctx.handle) if wants_values else None)
    return (*(bar if wants else None for bar, wants in zip(bars, wanted, strict=True)), None, None, None)


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
