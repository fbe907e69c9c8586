"""Muscles: an actuation field on the grid becomes stress along material directions."""

from __future__ import annotations

from torch import Tensor

from torchmpm.linalg import Mat2
from torchmpm.material import Sym2
from torchmpm.spline import Stencil, gather


def sample(stencil: Stencil, field: Tensor) -> tuple[Tensor, Tensor]:
    """Actuation of particles from the field on the nodes.

    Args:
        stencil: Stencils of the particles.
        field: (2, B, cells) actuation along material x and y on the padded grid, Pa.

    Returns:
        Two planes (B, N), Pa.
    """
    horizontal, vertical = (stencil.weights * gather(stencil, field)).sum((2, 3))
    return horizontal, vertical


def muscle_stress(F: Mat2, actuation: tuple[Tensor, Tensor]) -> Sym2:
    """Kirchhoff stress F diag(a) F^T (DittoGym, section 3). Positive actuation contracts.

    Between two F the muscle directions turn and stretch with the matter: they are material directions.
    """
    a, b, c, d = F
    ax, ay = actuation
    return ax * a * a + ay * b * b, ax * a * c + ay * b * d, ax * c * c + ay * d * d
