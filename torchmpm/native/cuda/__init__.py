"""The substep as Triton kernels on CUDA; the operators of :mod:`torchmpm.native.operator` on tensors that live there.

``programs`` launches the kernels of a step and of its adjoint, ``graphs`` keeps the launches as CUDA graphs. Kernels,
in order, each built on those before: ``linalg``, ``material``, ``transfer``, ``grid``, ``step``; for the adjoint
``material_adjoint``, ``adjoint``. They are the formulas of the C++ kernels, a thread for each particle or node.

Two launches make a substep: one over the particles, which reads velocities from the nodes, moves and deforms the
particles, and adds mass and momentum to the nodes for the next substep; one over the nodes that are in use. Additions
are atomic, in no fixed order: results differ from call to call in their last bits.

This package imports Triton; nothing else does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmpm.native.cuda.graphs import KEPT_SHARE, cache
from torchmpm.native.cuda.programs import Backward, Forward, Inputs, Program
from torchmpm.native.cuda.tables import device_tables

__all__ = ["backward", "cache", "forward"]


def forward(
    planes: Tensor,
    field: Tensor | None,
    origin: Tensor,
    gravity: Tensor,
    values: Tensor,
    shift: Tensor,
    handle: int,
    substeps: int,
) -> Tensor:
    """Advance all simulations; see :func:`torchmpm.native.operator.native_step`."""
    inputs = Inputs(planes, field, origin, gravity, values, shift)
    (result,) = _run(Forward, inputs, handle, substeps)
    return result


def backward(
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
    """Adjoint of :func:`forward`; see :func:`torchmpm.native.operator.native_step_backward`."""
    inputs = Inputs(planes, field, origin, gravity, values, shift, result_bar)
    planes_bar, field_bar, origin_bar, gravity_bar, values_bar = _run(
        Backward, inputs, handle, substeps, wants_field, wants_values
    )
    return planes_bar, field_bar, origin_bar, gravity_bar, values_bar


def _run(kind: type[Program], inputs: Inputs, handle: int, substeps: int, *wants: bool) -> tuple[Tensor, ...]:
    """Run a program, from a graph where that works: not while a caller records a graph of their own."""
    inputs = inputs.map(Tensor.contiguous)
    planes = inputs.planes
    tables = device_tables(handle, planes.dtype, planes.device)

    def build(own: Inputs) -> Program:
        return kind(own, tables, substeps, *wants)

    if planes.device.type != "cuda":
        return _launched(build(inputs))
    with torch.cuda.device(planes.device):
        if torch.cuda.is_current_stream_capturing():
            return _launched(build(inputs))
        shapes = (planes.shape, inputs.field is None, inputs.values.shape, planes.dtype, planes.device)
        # Two streams may run at once, so each has buffers of its own.
        stream = torch.cuda.current_stream().cuda_stream
        most = KEPT_SHARE * torch.cuda.get_device_properties(planes.device).total_memory
        return cache.run((kind, handle, substeps, wants, shapes, stream), build, inputs, most)


def _launched(program: Program) -> tuple[Tensor, ...]:
    program.run()
    return program.results()
