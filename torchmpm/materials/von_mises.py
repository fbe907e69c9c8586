"""Von Mises plasticity in principal logarithmic strains, the robot material of DittoGym (Huang et al., 2024).

The native kernels have the same formulas in ``native/common/material.hpp``.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchmpm import checks, tree
from torchmpm.materials.base import Value, broadcast_plane, check_not_negative
from torchmpm.materials.elastic import Elastic
from torchmpm.materials.linalg import Mat2, PolarParts, from_polar_parts, polar_parts

#: Lower bound of the principal stretches in the yield test.
STRETCH_FLOOR = 0.05
#: Constant under the square root of the norm of the deviatoric strain.
NORM_EPSILON = 1e-8
#: No difference of principal logarithmic strains reaches this: a larger yield limit never acts, but would overflow.
LARGEST_DIFFERENCE = 40.0


class YieldSurface(NamedTuple):
    """Functions of d, the difference of the principal logarithmic strains at yield."""

    tanh: Value  # tanh(d/2), difference over sum of the principal stretches
    exp: Value  # e^d, ratio of the principal stretches
    cosh2: Value  # 2 cosh(d/2), sum of the principal stretches of area one
    sinh2: Value  # 2 sinh(d/2), their difference


def yield_surface(limit: Value) -> YieldSurface:
    """Constants of the return map for a deviatoric strain at yield, by e^d - 1, which keeps the digits of small d."""
    square = 2.0 * (limit * limit - NORM_EPSILON)
    expm1: Value
    root: Value
    if isinstance(square, Tensor):
        d = square.clamp(NORM_EPSILON, LARGEST_DIFFERENCE**2).sqrt()
        expm1, root = d.expm1(), (0.5 * d).exp()
    else:
        number = math.sqrt(min(max(square, NORM_EPSILON), LARGEST_DIFFERENCE**2))
        expm1, root = math.expm1(number), math.exp(0.5 * number)
    return YieldSurface(expm1 / (expm1 + 2.0), expm1 + 1.0, root + 1.0 / root, expm1 / root)


def von_mises_return(F: Mat2, limit: Value) -> Mat2:
    """Project a deformation gradient onto the von Mises yield surface in principal logarithmic strains.

    This is the return mapping of Gao et al. ("An adaptive generalized interpolation material point method for
    simulating elastoplastic materials", 2017) with the constants of DittoGym (Huang et al., 2024). With e_1 >= e_2 the
    logarithms of the principal stretches, which are floored at 0.05, the deviator has the norm
    ``sqrt((e_1 - e_2)^2 / 2 + 1e-8)``. Where it exceeds ``limit``, the difference e_1 - e_2 is brought back to its
    value d at yield, ``sqrt(2 (limit^2 - 1e-8))``, but at least 1e-4; the area is kept, unless a stretch is below the
    floor. Elsewhere F is returned unchanged.

    No logarithm and no singular value decomposition are needed: every 2x2 matrix is the sum of a scaled rotation and a
    scaled reflection, whose lengths are half the sum and half the difference of the principal stretches. With g the
    geometric mean of the stretches, sum and difference after the return are 2 g cosh(d/2) and 2 g sinh(d/2).

    The derivative jumps at the yield surface; exactly on it, it is that of the elastic side.

    Args:
        F: Components (B, N) of the trial deformation gradient.
        limit: Norm of the deviatoric logarithmic strain at yield, yield stress / (2 mu); a number or a tensor that
            broadcasts to (B, N).

    Returns:
        Components (B, N) of the returned deformation gradient.
    """
    tanh, exp, cosh2, sinh2 = yield_surface(limit)
    m1, m2, n1, n2, proper = polar_parts(F)
    sum2, difference2 = m1.square() + m2.square(), n1.square() + n2.square()
    outside = difference2 > tanh * tanh * sum2
    # Where nothing yields, harmless numbers go through the square roots, so that no infinite derivative meets a zero.
    total = torch.where(outside, sum2, 1.0).sqrt()
    difference = torch.where(outside, difference2, 0.25).sqrt()
    major = (0.5 * (total + difference)).clamp_min(STRETCH_FLOOR)
    minor = (0.5 * (total - difference)).clamp_min(STRETCH_FLOOR)
    yields = outside & (major > minor * exp)
    mean = 0.5 * (major * minor).sqrt()
    grow_sum, grow_difference = mean * cosh2 / total, mean * sinh2 / difference
    returned = from_polar_parts(
        PolarParts(m1 * grow_sum, m2 * grow_sum, n1 * grow_difference, n2 * grow_difference, proper)
    )
    a, b, c, d = (torch.where(yields, new, old) for new, old in zip(returned, F, strict=True))
    return a, b, c, d


@tree.register
@dataclass(frozen=True, eq=False)
class VonMises(Elastic):
    """Fixed corotated solid that flows plastically once its deviatoric strain reaches a limit.

    The robot material of DittoGym (Huang et al., ICLR 2024): soft enough to be driven by muscles, plastic enough to
    keep a new shape. Its stress is that of :class:`torchmpm.Elastic`, its plastic flow that of
    :func:`torchmpm.materials.von_mises.von_mises_return`. A constant is a number or a tensor of shape (), (B,), (B, 1),
    (B, count) or (1, count) with the body's count.

    Attributes:
        mu: Second Lame parameter, Pa, positive.
        lam: First Lame parameter, Pa, at least -mu.
        yield_stress: Norm of the deviatoric stress at yield, Pa, at small strain: the largest shear stress is
            ``yield_stress / sqrt(2)``. What is limited is the norm of the deviatoric logarithmic strain, to
            ``yield_stress / (2 mu)``; the stress there depends on the change of area too.

    Raises:
        ValueError: ``mu`` is not positive, ``lam`` is below -mu (for a tensor: when a solver with
            ``allow_unstable=False`` is made), the yield stress is negative, or a constant is not finite.
        TypeError: A tensor is not dense.
    """

    yield_stress: Value

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.entries("mu", self.mu, above=0.0)  # the strain at yield is a stress divided by it
        check_not_negative(self, "yield_stress")

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Isochoric return of ``F`` to the yield surface, components (B, N), and ``Jp`` (B, N) as it is.

        See :func:`von_mises_return`.
        """
        yield_stress, mu = broadcast_plane(self.yield_stress, Jp, "yield_stress"), broadcast_plane(self.mu, Jp, "mu")
        return von_mises_return(F, yield_stress / (2.0 * mu)), Jp
