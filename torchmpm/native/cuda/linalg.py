"""2x2 matrices as the sum of a scaled rotation and a scaled reflection; see :mod:`torchmpm.materials.linalg`.

A matrix is four numbers, row by row; its parts are the larger one (m1, m2), the smaller one (n1, n2), and ``proper``:
whether the larger one is the rotation.
"""

import triton
import triton.language as tl


@triton.jit
def split(a, b, c, d):
    """Parts (m1, m2, n1, n2, proper)."""
    proper = (a + d) * (a + d) + (c - b) * (c - b) >= (a - d) * (a - d) + (b + c) * (b + c)
    m1, m2, n1, n2 = join_adjoint(a, b, c, d, proper)
    return m1, m2, n1, n2, proper


@triton.jit
def join(m1, m2, n1, n2, proper):
    """Twice the inverse of split, which is also its adjoint."""
    p, q = tl.where(proper, m1, n1), tl.where(proper, m2, n2)
    r, s = tl.where(proper, n1, m1), tl.where(proper, n2, m2)
    return p + r, s - q, q + s, p - r


@triton.jit
def join_adjoint(a, b, c, d, proper):
    """From derivatives in the result of join to those in (m1, m2, n1, n2)."""
    p, q, r, s = a + d, c - b, a - d, b + c
    return tl.where(proper, p, r), tl.where(proper, q, s), tl.where(proper, r, p), tl.where(proper, s, q)


@triton.jit
def direction(m1, m2):
    """Sum of the stretches, one over it, cosine and sine of the orthogonal factor R, and whether F = 0."""
    square = m1 * m1 + m2 * m2
    empty = square == 0
    total = tl.sqrt(tl.where(empty, 1.0, square))
    inverse = 1.0 / total
    return tl.where(empty, 0.0, total), inverse, tl.where(empty, 1.0, m1 * inverse), m2 * inverse, empty


@triton.jit
def direction_adjoint(inverse, cos, sin, empty, total_bar, cos_bar, sin_bar):
    """From derivatives in sum and direction to those in (m1, m2)."""
    turn = (sin * cos_bar - cos * sin_bar) * inverse
    m1 = sin * turn + total_bar * cos
    m2 = total_bar * sin - cos * turn
    return tl.where(empty, 0.0, m1), tl.where(empty, sin_bar, m2)


@triton.jit
def matmul(a, b, c, d, e, f, g, h):
    """Matrix product."""
    return a * e + b * g, a * f + b * h, c * e + d * g, c * f + d * h


@triton.jit
def at_least(value, floor):
    """The larger of two; NaN in ``value`` is propagated."""
    return tl.where(value < floor, floor, value)


@triton.jit
def clamp(value, low, high):
    """Value within [low, high]; NaN is propagated."""
    return tl.where(value < low, low, tl.where(value > high, high, value))
