"""Return maps and stresses in kernels; see :mod:`torchmpm.materials` for the formulas and their sources.

A particle's values are the eight numbers of :func:`torchmpm.native.tables.make_values`: mass, factor = -dt V 4/h^2,
2 mu, lam, and four that belong to the material (``s0`` to ``s3``).
"""

import triton
import triton.language as tl

from torchmpm.materials import snow
from torchmpm.native.cuda.linalg import at_least, clamp, direction, join, matmul, split

#: Places in ``tables.KINDS``.
VON_MISES = tl.constexpr(1)
SNOW = tl.constexpr(2)
#: Of :mod:`torchmpm.materials.snow`.
LARGEST_STRAIN = tl.constexpr(snow.LARGEST_STRAIN)
#: Places in the table of constants, see :class:`torchmpm.native.cuda.tables.DeviceTables`.
H, INVERSE_H, DT, MARGIN, EXTENT, DAMPING, MASS_EPSILON, STRETCH_FLOOR, LARGEST_JP = (tl.constexpr(k) for k in range(9))


@triton.jit
def read_values(values, values_batch, columns, at, mask):
    """The eight values of particles that stand at ``at`` in each row of their table (8, values_batch, columns)."""
    first, row = values + at, values_batch.to(tl.int64) * columns
    mass, factor = tl.load(first, mask, other=1.0), tl.load(first + row, mask, other=1.0)
    mu2, lam = tl.load(first + 2 * row, mask, other=1.0), tl.load(first + 3 * row, mask, other=1.0)
    s0, s1 = tl.load(first + 4 * row, mask, other=1.0), tl.load(first + 5 * row, mask, other=1.0)
    s2, s3 = tl.load(first + 6 * row, mask, other=1.0), tl.load(first + 7 * row, mask, other=1.0)
    return mass, factor, mu2, lam, s0, s1, s2, s3


@triton.jit
def von_mises_parts(total, m1, m2, n1, n2, tanh2, exp, constants):
    """What the von Mises return and its adjoint share: difference of the stretches, these, and where they yield."""
    floor, small = tl.load(constants + STRETCH_FLOOR), n1 * n1 + n2 * n2
    outside = small > tanh2 * (m1 * m1 + m2 * m2)
    total = tl.where(outside, total, 1.0)
    difference = tl.sqrt(tl.where(outside, small, 0.25))
    first, second = 0.5 * (total + difference), 0.5 * (total - difference)
    major, minor = at_least(first, floor), at_least(second, floor)
    return difference, first, second, major, minor, outside & (major > minor * exp), 0.5 * tl.sqrt(major * minor)


@triton.jit
def von_mises_return(a, b, c, d, tanh2, exp, cosh2, sinh2, constants):
    """Returned deformation gradient."""
    m1, m2, n1, n2, proper = split(a, b, c, d)
    total, _, cos, sin, _ = direction(m1, m2)
    difference, _, _, _, _, yields, mean = von_mises_parts(total, m1, m2, n1, n2, tanh2, exp, constants)
    grow_total, grow_difference = mean * cosh2, mean * (sinh2 / difference)
    e, f, g, h = join(grow_total * cos, grow_total * sin, grow_difference * n1, grow_difference * n2, proper)
    return tl.where(yields, e, a), tl.where(yields, f, b), tl.where(yields, g, c), tl.where(yields, h, d)


@triton.jit
def snow_parts(m1, m2, n1, n2, low, high, shear_cutoff):
    """What the return map of snow and its adjoint share: the smaller part without its dropped shear, and stretches."""
    total, _, cos, sin, _ = direction(m1, m2)
    along = n1 * cos + n2 * sin
    drop = tl.abs(n2 * cos - n1 * sin) < 2.0 * shear_cutoff
    n1, n2 = tl.where(drop, along * cos, n1), tl.where(drop, along * sin, n2)
    square = n1 * n1 + n2 * n2
    isotropic = square == 0
    root = tl.sqrt(tl.where(isotropic, 1.0, square))
    difference = tl.where(isotropic, 0.0, root)
    first, second = 0.5 * (total + difference), 0.5 * (total - difference)
    major, minor = clamp(first, low, high), clamp(second, low, high)
    kept = (first <= high) & (second >= low)
    ratio = 0.5 * tl.where(kept, 1.0, (major - minor) / root)
    return n1, n2, along, drop, isotropic, kept, root, first, second, major, minor, ratio


@triton.jit
def snow_return(a, b, c, d, Jp, low, high, constants, bounds):
    """Returned deformation gradient and Jp."""
    m1, m2, n1, n2, proper = split(a, b, c, d)
    _, _, cos, sin, _ = direction(m1, m2)
    n1, n2, _, _, _, _, _, first, second, major, minor, ratio = snow_parts(
        m1, m2, n1, n2, low, high, tl.load(bounds + 2)
    )
    sum = 0.5 * (major + minor)
    e, f, g, h = join(sum * cos, sum * sin, ratio * n1, ratio * n2, proper)
    largest = tl.load(constants + LARGEST_JP)
    grown = Jp * (first * second / (major * minor))
    return e, f, g, h, tl.where(grown > largest, largest, grown)


@triton.jit
def return_map(a, b, c, d, Jp, s0, s1, s2, s3, constants, bounds, KIND: tl.constexpr):
    """Projected deformation gradient and Jp of one material."""
    if KIND == VON_MISES:
        a, b, c, d = von_mises_return(a, b, c, d, s0, s1, s2, s3, constants)
    elif KIND == SNOW:
        a, b, c, d, Jp = snow_return(a, b, c, d, Jp, s0, s1, constants, bounds)
    return a, b, c, d, Jp


@triton.jit
def hardening_factor(Jp, hardening, bounds, KIND: tl.constexpr):
    """Factor on the elastic constants; Jp is that of before the return map."""
    factor = tl.full(Jp.shape, 1.0, Jp.dtype)
    if KIND == SNOW:
        factor = clamp(tl.exp(hardening * (1.0 - Jp)), tl.load(bounds), tl.load(bounds + 1))
    return factor


@triton.jit
def orthogonal(a, b, c, d):
    """R of the trial deformation; return maps keep it."""
    m1, m2, _, _, proper = split(a, b, c, d)
    _, _, cos, sin, _ = direction(m1, m2)
    zero = tl.zeros_like(a)
    return join(cos, sin, zero, zero, proper)


@triton.jit
def stress(a, b, c, d, r0, r1, r2, r3, mu2, lam, act_x, act_y, KIND: tl.constexpr):
    """Kirchhoff stress (xx, xy, yy) of the fixed corotated solid with the orthogonal factor r, and of the muscles."""
    e, f, g, h = a - r0, b - r1, c - r2, d - r3
    J = a * d - b * c
    if KIND == SNOW:
        J = tl.abs(J)
    pressure = lam * (J * (J - 1.0))
    xx = mu2 * (e * a + f * b) + pressure + act_x * a * a + act_y * b * b
    xy = mu2 * (e * c + f * d) + act_x * a * c + act_y * b * d
    yy = mu2 * (g * c + h * d) + pressure + act_x * c * c + act_y * d * d
    return xx, xy, yy


@triton.jit
def deform(
    dt, c0, c1, c2, c3, f0, f1, f2, f3, Jp, factor, mu2, lam, s0, s1, s2, s3, act_x, act_y, constants, bounds,
    KIND: tl.constexpr,
):  # fmt: skip
    """Deformation gradient and Jp after a substep, and ``-dt V 4/h^2 tau``."""
    t0, t1, t2, t3 = matmul(1.0 + dt * c0, dt * c1, dt * c2, 1.0 + dt * c3, f0, f1, f2, f3)
    a, b, c, d, after = return_map(t0, t1, t2, t3, Jp, s0, s1, s2, s3, constants, bounds, KIND)
    r0, r1, r2, r3 = orthogonal(t0, t1, t2, t3)
    hard = hardening_factor(Jp, s2, bounds, KIND)
    xx, xy, yy = stress(a, b, c, d, r0, r1, r2, r3, hard * mu2, hard * lam, act_x, act_y, KIND)
    return a, b, c, d, after, factor * xx, factor * xy, factor * yy
