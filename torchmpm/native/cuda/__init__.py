"""The kernels in Triton, for tensors on CUDA; what :mod:`torchmpm.native.kernels` calls there.

``programs`` launches the kernels of a step and of its adjoint, ``graphs`` keeps the launches as CUDA graphs. Kernels,
in the order in which they build on each other: ``linalg``, ``material``, ``transfer``, ``grid``, ``step``; for the
adjoint ``material_adjoint``, ``adjoint``. They compute the formulas of the C++ kernels, one thread a particle or node.

A substep takes one launch for each body, which reads velocities from the nodes, moves and deforms the particles, and
adds mass and momentum to the nodes for the next substep, and one over the nodes that are in use. Additions are atomic,
in no fixed order: results differ from call to call in their last bits.
"""

import torch
from torch import Tensor

from torchmpm.native.cuda.graphs import KEPT_SHARE, cache
from torchmpm.native.cuda.programs import Backward, Forward, Program
from torchmpm.native.cuda.tables import device_tables
from torchmpm.native.tables import Inputs, Tables

__all__ = ["backward", "cache", "forward"]


def forward(inputs: Inputs, tables: Tables, substeps: int) -> Tensor:
    """Advance all simulations; see :func:`torchmpm.native.kernels.forward`."""
    (result,) = _run(Forward, inputs, tables, substeps)
    return result


def backward(inputs: Inputs, tables: Tables, substeps: int, *wants: bool) -> tuple[Tensor, ...]:
    """Adjoint of :func:`forward`; see :func:`torchmpm.native.kernels.backward`."""
    return _run(Backward, inputs, tables, substeps, *wants)


def _run(kind: type[Program], inputs: Inputs, tables: Tables, substeps: int, *wants: bool) -> tuple[Tensor, ...]:
    """Run a program, from a graph where that works: not while the caller records a graph of their own."""
    planes = inputs.components
    constants = device_tables(tables, planes.dtype, planes.device)

    def build(own: Inputs) -> Program:
        return kind(own, constants, substeps, *wants)

    if planes.device.type != "cuda":
        return build(inputs).run()
    with torch.cuda.device(planes.device):
        if torch.cuda.is_current_stream_capturing():
            return build(inputs).run()
        shapes = (planes.shape, inputs.field is None, inputs.values.shape, planes.dtype, planes.device)
        # Two streams may run at once, so each has buffers of its own.
        stream = torch.cuda.current_stream().cuda_stream
        most = KEPT_SHARE * torch.cuda.get_device_properties(planes.device).total_memory
        return cache.run((kind, tables, substeps, wants, shapes, stream), build, inputs, most)
