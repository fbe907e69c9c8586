"""Muscles: active stress along material directions."""

from torch import Tensor

from torchmpm.materials.linalg import Mat2, Sym2


def muscle_stress(F: Mat2, actuation: tuple[Tensor, Tensor]) -> Sym2:
    """Kirchhoff stress F diag(a) F^T (DittoGym, Huang et al., 2024, section 3), planes (B, N), Pa.

    Positive actuation a, Pa, contracts. Its directions turn and stretch with the material.
    """
    a, b, c, d = F
    ax, ay = actuation
    return ax * a * a + ay * b * b, ax * a * c + ay * b * d, ax * c * c + ay * d * d
