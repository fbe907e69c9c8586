"""Closed forms for 2x2 matrices given as planes ``(F11, F12, F21, F22)``.

Every matrix is half the sum of a scaled rotation ``[[p, -q], [q, p]]`` and a scaled reflection ``[[r, s], [s, -r]]``
with ``p = F11 + F22, q = F21 - F12, r = F11 - F22, s = F12 + F21``. The lengths ``|(p, q)|`` and ``|(r, s)|`` are the
sum and the difference of the singular values; the larger one belongs to the sum. All that the materials need
follows from this without an SVD, whose derivative breaks down at equal singular values, so at F = I.
"""

from __future__ import annotations

from typing import TypeAlias

import torch
from torch import Tensor

#: Planes (F11, F12, F21, F22) of a field of 2x2 matrices, all of one shape.
Mat2: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor]


def split(F: Mat2) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Coefficients (p, q, r, s) of the rotation and the reflection part."""
    a, b, c, d = F
    return a + d, c - b, a - d, b + c


def det(F: Mat2) -> Tensor:
    """Determinant."""
    a, b, c, d = F
    return a * d - b * c


def matmul(A: Mat2, B: Mat2) -> Mat2:
    """Matrix product A B."""
    a, b, c, d = A
    e, f, g, h = B
    return a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h


def polar(F: Mat2) -> Mat2:
    """Orthogonal factor R of F = R S with S symmetric positive semidefinite.

    For det F < 0 it is a reflection, so singular values stay non-negative; F = 0 gives R = I. The chosen part is never
    shorter than the Frobenius norm of F, so the derivative is bounded on either side of det F = 0 (at which R jumps).
    """
    p, q, r, s = split(F)
    rotation, reflection = p.square() + q.square(), r.square() + s.square()
    proper = rotation >= reflection
    length2 = torch.where(proper, rotation, reflection)
    empty = length2 == 0
    scale = torch.rsqrt(torch.where(empty, 1.0, length2))
    cos = torch.where(empty, 1.0, torch.where(proper, p, r) * scale)
    sin = torch.where(proper, q, s) * scale
    return cos, torch.where(proper, -sin, sin), sin, torch.where(proper, cos, -cos)
