"""Closed forms for 2x2 matrices given as components ``(F11, F12, F21, F22)``.

Every matrix is half the sum of a scaled rotation ``[[p, -q], [q, p]]`` and a scaled reflection ``[[r, s], [s, -r]]``
with ``p = F11 + F22, q = F21 - F12, r = F11 - F22, s = F12 + F21``. Of the vectors (p, q) and (r, s) the longer one, m,
has the sum of the singular values as its length, and the shorter one, n, their difference. The direction of m is that
of the orthogonal factor R of ``F = R S``. All that the materials need follows from this without an SVD, whose
derivative breaks down at equal singular values, hence at F = I.
"""

from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

#: Components (F11, F12, F21, F22) of a field of 2x2 matrices, four tensors of one shape, such as (B, N).
Mat2: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor]
#: Components (xx, xy, yy) of a field of symmetric 2x2 matrices, three tensors of one shape, such as (B, N).
Sym2: TypeAlias = tuple[Tensor, Tensor, Tensor]


class PolarParts(NamedTuple):
    """A matrix as its rotation and reflection part."""

    m1: Tensor  # the longer of the two vectors
    m2: Tensor
    n1: Tensor  # the shorter one
    n2: Tensor
    proper: Tensor  # whether the longer one belongs to the rotation, as it does where det F >= 0


def safe_sqrt(square: Tensor) -> Tensor:
    """Square root whose derivative is 0 at 0."""
    zero = square == 0
    return torch.where(zero, 0.0, torch.where(zero, 1.0, square).sqrt())


def polar_parts(F: Mat2) -> PolarParts:
    """Rotation and reflection part of F."""
    a, b, c, d = F
    p, q, r, s = a + d, c - b, a - d, b + c
    proper = p.square() + q.square() >= r.square() + s.square()
    m1, m2 = torch.where(proper, p, r), torch.where(proper, q, s)
    return PolarParts(m1, m2, torch.where(proper, r, p), torch.where(proper, s, q), proper)


def from_polar_parts(parts: PolarParts) -> Mat2:
    """Twice the inverse of :func:`polar_parts`."""
    m1, m2, n1, n2, proper = parts
    p, q = torch.where(proper, m1, n1), torch.where(proper, m2, n2)
    r, s = torch.where(proper, n1, m1), torch.where(proper, n2, m2)
    return p + r, s - q, q + s, p - r


def direction(parts: PolarParts) -> tuple[Tensor, Tensor, Tensor]:
    """Length of the longer part (the sum of the singular values), and its cosine and sine; (0, 1, 0) for F = 0."""
    square = parts.m1.square() + parts.m2.square()
    empty = square == 0
    total = torch.where(empty, 1.0, square).sqrt()
    return torch.where(empty, 0.0, total), torch.where(empty, 1.0, parts.m1 / total), parts.m2 / total


def orthogonal(F: Mat2) -> Mat2:
    """Orthogonal factor R of the polar decomposition F = R S with S symmetric positive semidefinite.

    For det F < 0 it is a reflection, so singular values stay non-negative; F = 0 gives R = I. The longer part is never
    shorter than the Frobenius norm of F, so the derivative is bounded on either side of det F = 0 (where R jumps).
    """
    m1, m2, _, _, proper = polar_parts(F)
    square = m1.square() + m2.square()
    empty = square == 0
    inverse = torch.rsqrt(torch.where(empty, 1.0, square))
    cos, sin = torch.where(empty, 1.0, m1 * inverse), m2 * inverse
    return cos, torch.where(proper, -sin, sin), sin, torch.where(proper, cos, -cos)


def det(F: Mat2) -> Tensor:
    """Return the determinant of matrices ``F``, with the shape of one of their components."""
    a, b, c, d = F
    return a * d - b * c


def matmul(A: Mat2, B: Mat2) -> Mat2:
    """Matrix product A B."""
    a, b, c, d = A
    e, f, g, h = B
    return a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h
