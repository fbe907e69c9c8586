"""Adjoints of the material laws in kernels. Names with ``bar`` are derivatives of a loss.

At corners the derivative is that of the side which automatic differentiation of :mod:`torchmpm.materials` takes.
"""

import triton
import triton.language as tl

from torchmpm.native.cuda.linalg import at_least, direction, direction_adjoint, join, join_adjoint, split
from torchmpm.native.cuda.material import (
    LARGEST_JP,
    SNOW,
    VON_MISES,
    hardening_factor,
    orthogonal,
    return_map,
    snow_parts,
    stress,
    von_mises_parts,
)


@triton.jit
def tangent_hardening(hard, mass, factor, mu2, lam, bounds, KIND: tl.constexpr):
    """The hardening factor in the derivative of the stress with respect to F, see :class:`torchmpm.Snow`."""
    if KIND == SNOW:
        limit = 4.0 * tl.load(bounds + 3) * mass / (-factor * (mu2 + 2.0 * at_least(lam, 0.0)))
        hard = tl.where(limit < hard, limit, hard)
    return hard


@triton.jit
def stress_adjoint(a, b, c, d, r0, r1, r2, r3, proper, mu2, lam, act_x, act_y, xx, xy, yy, KIND: tl.constexpr):
    """From the derivative in the Kirchhoff stress (xx, xy, yy) to those in all that made it.

    Returns:
        Derivatives in F (four), in the cosine and sine of R, in both pulls, and in 2 mu and lam.
    """
    e, f, g, h = a - r0, b - r1, c - r2, d - r3
    e_bar, f_bar = mu2 * (xx * a + xy * c), mu2 * (xx * b + xy * d)
    g_bar, h_bar = mu2 * yy * c, mu2 * yy * d
    cos_bar, sin_bar, _, _ = join_adjoint(e_bar, f_bar, g_bar, h_bar, proper)
    signed = a * d - b * c
    J, side = signed, 1.0
    if KIND == SNOW:
        J = tl.abs(signed)
        side = tl.where(signed > 0, 1.0, tl.where(signed < 0, -1.0, 0.0))
    area = side * ((xx + yy) * lam * (2.0 * J - 1.0))
    xa, xc, yb, yd = act_x * a, act_x * c, act_y * b, act_y * d
    a_bar = e_bar + mu2 * xx * e + area * d + 2.0 * xx * xa + xy * xc
    b_bar = f_bar + mu2 * xx * f - area * c + 2.0 * xx * yb + xy * yd
    c_bar = g_bar + mu2 * (xy * e + yy * g) - area * b + xy * xa + 2.0 * yy * xc
    d_bar = h_bar + mu2 * (xy * f + yy * h) + area * a + xy * yb + 2.0 * yy * yd
    act_x_bar = xx * a * a + xy * a * c + yy * c * c
    act_y_bar = xx * b * b + xy * b * d + yy * d * d
    of_mu2 = xx * (e * a + f * b) + xy * (e * c + f * d) + yy * (g * c + h * d)
    of_lam = (xx + yy) * (J * (J - 1.0))
    return a_bar, b_bar, c_bar, d_bar, -cos_bar, -sin_bar, act_x_bar, act_y_bar, of_mu2, of_lam


@triton.jit
def von_mises_adjoint(
    a, b, c, d, tanh2, exp, cosh2, sinh2, a_bar, b_bar, c_bar, d_bar, cos_bar, sin_bar, constants
):  # fmt: skip
    """From derivatives in the returned F and in R to those in the trial F (four), in cosh2 and sinh2."""
    m1, m2, n1, n2, proper = split(a, b, c, d)
    total, inverse_total, cos, sin, empty = direction(m1, m2)
    difference, first, second, major, minor, yields, mean = von_mises_parts(
        total, m1, m2, n1, n2, tanh2, exp, constants
    )
    inverse = 1.0 / difference
    grow_total, grow_difference = mean * cosh2, mean * (sinh2 * inverse)

    m1_bar, m2_bar, n1_bar, n2_bar = join_adjoint(a_bar, b_bar, c_bar, d_bar, proper)
    of_total, of_difference = m1_bar * cos + m2_bar * sin, n1_bar * n1 + n2_bar * n2
    mean_bar = of_total * cosh2 + of_difference * sinh2 * inverse
    major_bar = tl.where(major == first, mean_bar * mean / (2.0 * major), 0.0)
    minor_bar = tl.where(minor == second, mean_bar * mean / (2.0 * minor), 0.0)
    along = (0.5 * (major_bar - minor_bar) - of_difference * grow_difference * inverse) * inverse
    cosh2_bar = tl.where(yields, of_total * mean, 0.0)
    sinh2_bar = tl.where(yields, of_difference * mean * inverse, 0.0)
    total_bar = tl.where(yields, 0.5 * (major_bar + minor_bar), 0.0)
    cos_bar += tl.where(yields, grow_total * m1_bar, 0.0)
    sin_bar += tl.where(yields, grow_total * m2_bar, 0.0)
    m1_bar, m2_bar = direction_adjoint(inverse_total, cos, sin, empty, total_bar, cos_bar, sin_bar)
    n1_bar = tl.where(yields, grow_difference * n1_bar + along * n1, 0.0)
    n2_bar = tl.where(yields, grow_difference * n2_bar + along * n2, 0.0)
    e, f, g, h = join(m1_bar, m2_bar, n1_bar, n2_bar, proper)
    e, f = e + tl.where(yields, 0.0, a_bar), f + tl.where(yields, 0.0, b_bar)
    return e, f, g + tl.where(yields, 0.0, c_bar), h + tl.where(yields, 0.0, d_bar), cosh2_bar, sinh2_bar


@triton.jit
def snow_adjoint(
    a, b, c, d, Jp, low, high, a_bar, b_bar, c_bar, d_bar, cos_bar, sin_bar, Jp_bar, constants, bounds
):  # fmt: skip
    """From derivatives in the returned F, in R and Jp to those in the trial F (four), in Jp, and in low and high."""
    m1, m2, p1, p2, proper = split(a, b, c, d)
    _, inverse, cos, sin, empty = direction(m1, m2)
    n1, n2, along, drop, isotropic, kept, root, first, second, major, minor, ratio = snow_parts(
        m1, m2, p1, p2, low, high, tl.load(bounds + 2)
    )
    sum = 0.5 * (major + minor)
    reduction = first * second / (major * minor)
    Jp_bar = tl.where(Jp * reduction > tl.load(constants + LARGEST_JP), 0.0, Jp_bar)
    reduction_bar = Jp_bar * Jp

    m1_bar, m2_bar, n1_bar, n2_bar = join_adjoint(a_bar, b_bar, c_bar, d_bar, proper)
    sum_bar = m1_bar * cos + m2_bar * sin
    ratio_bar = tl.where(kept | isotropic, 0.0, n1_bar * n1 + n2_bar * n2)
    major_bar = 0.5 * (sum_bar + ratio_bar / root) - reduction_bar * reduction / major
    minor_bar = 0.5 * (sum_bar - ratio_bar / root) - reduction_bar * reduction / minor
    area = reduction_bar / (major * minor)
    low1, high1, low2, high2 = first < low, first > high, second < low, second > high
    first_bar = area * second + tl.where(low1 | high1, 0.0, major_bar)
    second_bar = area * first + tl.where(low2 | high2, 0.0, minor_bar)
    low_bar = tl.where(low1, major_bar, 0.0) + tl.where(low2, minor_bar, 0.0)
    high_bar = tl.where(high1, major_bar, 0.0) + tl.where(high2, minor_bar, 0.0)

    difference_bar = tl.where(isotropic, 0.0, 0.5 * (first_bar - second_bar) - ratio_bar * ratio / root)
    n1_bar = ratio * n1_bar + difference_bar * n1 / root
    n2_bar = ratio * n2_bar + difference_bar * n2 / root
    along_bar = n1_bar * cos + n2_bar * sin
    cos_bar += sum * m1_bar + tl.where(drop, along * n1_bar + along_bar * p1, 0.0)
    sin_bar += sum * m2_bar + tl.where(drop, along * n2_bar + along_bar * p2, 0.0)
    total_bar = 0.5 * (first_bar + second_bar)
    m1_bar, m2_bar = direction_adjoint(inverse, cos, sin, empty, total_bar, cos_bar, sin_bar)
    n1_bar, n2_bar = tl.where(drop, along_bar * cos, n1_bar), tl.where(drop, along_bar * sin, n2_bar)
    e, f, g, h = join(m1_bar, m2_bar, n1_bar, n2_bar, proper)
    return e, f, g, h, Jp_bar * reduction, low_bar, high_bar


@triton.jit
def elastic_adjoint(a, b, c, d, a_bar, b_bar, c_bar, d_bar, cos_bar, sin_bar):
    """From derivatives in F and in R to those in F alone."""
    m1, m2, _, _, proper = split(a, b, c, d)
    _, inverse, cos, sin, empty = direction(m1, m2)
    zero = tl.zeros_like(a)
    m1_bar, m2_bar = direction_adjoint(inverse, cos, sin, empty, zero, cos_bar, sin_bar)
    e, f, g, h = join(m1_bar, m2_bar, zero, zero, proper)
    return a_bar + e, b_bar + f, c_bar + g, d_bar + h


@triton.jit
def hardening_adjoint(Jp, hardening, hard_bar, bounds):
    """Derivatives in Jp and in the exponent through the hardening factor of snow."""
    power = tl.exp(hardening * (1.0 - Jp))
    low, high = tl.load(bounds), tl.load(bounds + 1)
    free = (power >= low) & (power <= high)
    exponent = tl.where(low < high, tl.where(free, hard_bar * power, 0.0), 0.0)
    return -exponent * hardening, exponent * (1.0 - Jp)


@triton.jit
def material_adjoint(
    a, b, c, d, Jp, mass, factor, mu2, lam, s0, s1, s2, s3, act_x, act_y, xx_bar, xy_bar, yy_bar,
    a_bar, b_bar, c_bar, d_bar, Jp_bar, constants, bounds, KIND: tl.constexpr,
):  # fmt: skip
    """Adjoint of return map and stress together.

    Takes the trial F, the derivatives in S = factor tau, and those in the returned F and Jp.

    Returns:
        Derivatives in the trial F (four) and Jp, S itself (three), derivatives in both pulls, and in the values:
        factor, 2 mu, lam, and the four of the material.
    """
    e, f, g, h, _ = return_map(a, b, c, d, Jp, s0, s1, s2, s3, constants, bounds, KIND)
    r0, r1, r2, r3 = orthogonal(a, b, c, d)
    _, _, _, _, proper = split(a, b, c, d)
    hard = hardening_factor(Jp, s2, bounds, KIND)
    xx, xy, yy = stress(e, f, g, h, r0, r1, r2, r3, hard * mu2, hard * lam, act_x, act_y, KIND)
    factor_bar = xx_bar * xx + xy_bar * xy + yy_bar * yy
    tangent = tangent_hardening(hard, mass, factor, mu2, lam, bounds, KIND)
    e_bar, f_bar, g_bar, h_bar, cos_bar, sin_bar, act_x_bar, act_y_bar, of_mu2, of_lam = stress_adjoint(
        e, f, g, h, r0, r1, r2, r3, proper, tangent * mu2, tangent * lam, act_x, act_y,
        factor * xx_bar, factor * xy_bar, factor * yy_bar, KIND,
    )  # fmt: skip
    a_bar, b_bar, c_bar, d_bar = a_bar + e_bar, b_bar + f_bar, c_bar + g_bar, d_bar + h_bar
    zero = tl.zeros_like(a)
    s0_bar, s1_bar, s2_bar, s3_bar = zero, zero, zero, zero
    if KIND == VON_MISES:
        a_bar, b_bar, c_bar, d_bar, s2_bar, s3_bar = von_mises_adjoint(
            a, b, c, d, s0, s1, s2, s3, a_bar, b_bar, c_bar, d_bar, cos_bar, sin_bar, constants
        )
    elif KIND == SNOW:
        Jp_hard, s2_bar = hardening_adjoint(Jp, s2, mu2 * of_mu2 + lam * of_lam, bounds)
        a_bar, b_bar, c_bar, d_bar, Jp_bar, s0_bar, s1_bar = snow_adjoint(
            a, b, c, d, Jp, s0, s1, a_bar, b_bar, c_bar, d_bar, cos_bar, sin_bar, Jp_bar, constants, bounds
        )
        Jp_bar += Jp_hard
    else:
        a_bar, b_bar, c_bar, d_bar = elastic_adjoint(a, b, c, d, a_bar, b_bar, c_bar, d_bar, cos_bar, sin_bar)
    return (
        a_bar, b_bar, c_bar, d_bar, Jp_bar, factor * xx, factor * xy, factor * yy, act_x_bar, act_y_bar,
        factor_bar, hard * of_mu2, hard * of_lam, s0_bar, s1_bar, s2_bar, s3_bar,
    )  # fmt: skip
