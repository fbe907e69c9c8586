"""The tensors that the kernels read."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Inputs(NamedTuple):
    """Tensors of a call, a tree for ``torchmpm.tree``.

    Attributes:
        planes: (13, B, N) components of the state, see :meth:`torchmpm.ParticleState.planes`.
        field: (B, 2, G, G) muscle actuation on the nodes, Pa, or ``None``.
        origin: (B, 2) lower left corner of the window, m.
        gravity: (B, 2) acceleration, m/s^2.
        values: (8, 1 or B, columns) from :func:`torchmpm.native.tables.make_values`.
        shift: (B, 2) int64, nodes between the world's origin and the window's.
        result_bar: (13, B, N) derivative of a loss in the new planes, only for the adjoint.
    """

    planes: Tensor
    field: Tensor | None
    origin: Tensor
    gravity: Tensor
    values: Tensor
    shift: Tensor
    result_bar: Tensor | None = None
