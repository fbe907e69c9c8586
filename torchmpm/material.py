"""Constitutive laws: elastic, von Mises elasto-plastic, and soil."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor

from torchmpm import checks
from torchmpm.linalg import Mat2, det, polar, split

#: A number, or a tensor of shape (), (B,) for one value per simulation, or (B, N) for one per particle.
Value: TypeAlias = "float | Tensor"
#: Planes (xx, xy, yy) of a symmetric matrix.
Sym2: TypeAlias = tuple[Tensor, Tensor, Tensor]

#: Principal stretches below this count as this in the yield test.
STRETCH_FLOOR = 0.05
#: Constant under the square root of the norm of the deviatoric strain.
NORM_EPSILON = 1e-8
#: No difference of principal logarithmic strains reaches this: a yield limit beyond it never acts, but would overflow.
LARGEST_DIFFERENCE = 40.0
#: Jp of soil stays below this. A grain that is pulled apart for ever has lost all stiffness long before, at Jp = 1.23;
#: its Jp would go on growing until it is no number any more, and spoil gradients.
LARGEST_JP = 1e30


@runtime_checkable
class Material(Protocol):
    """What the solver asks of a material.

    All methods take ``F``, the planes (B, N) of a deformation gradient, and ``Jp``, the plastic volume ratio (B, N).
    """

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Project the trial ``F`` onto the elastic range; the new planes (B, N) and ``Jp`` (B, N)."""

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Kirchhoff stress of the projected ``F``, planes (B, N), Pa; ``Jp`` is from before the projection."""

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Stored energy per unit volume at ``F`` and ``Jp``, (B, N), J/m^2 (two-dimensional)."""

    def stiffness(self) -> Value:
        """Largest stress per strain in undeformed matter, over all kinds of strain (Frobenius norms), Pa."""


def lame(young: Value, poisson: Value) -> tuple[Value, Value]:
    """Lame parameters in plane strain.

    Args:
        young: Young's modulus, Pa; a number or a tensor of any shape, such as (B,).
        poisson: Poisson's ratio, between -1 and 0.5; likewise a number or a tensor.

    Returns:
        (mu, lam) in Pa, numbers or tensors of the arguments' shape.

    Raises:
        ValueError: A number is out of range.
    """
    checks.value("young", young, least=0.0)
    checks.value("poisson", poisson)
    if not isinstance(poisson, Tensor) and not -1 < poisson < 0.5:
        raise ValueError(f"poisson must be above -1 and below 0.5, got {poisson}")
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def column(value: Value, like: Tensor, name: str = "value") -> Value:
    """Bring a material value to a shape that broadcasts against planes (B, N).

    Raises:
        ValueError: A tensor has a shape other than (), (B,), (B, N) or (1, N).
    """
    if not isinstance(value, Tensor):
        return value
    value = value.to(like)
    batch, count = like.shape
    if value.ndim == 1 and value.shape[0] == batch:
        return value[:, None]
    if value.ndim == 0 or (value.ndim == 2 and value.shape[0] in (1, batch) and value.shape[1] in (1, count)):
        return value
    raise ValueError(f"{name} must be a number or have shape (), ({batch},) or ({batch}, {count}), got {value.shape}")


def spread(value: Value) -> Value:
    """A material value on its own, without graph, so that it broadcasts against others: (B,) becomes (B, 1)."""
    if not isinstance(value, Tensor):
        return value
    value = value.detach().to("cpu", torch.float64)
    return value[:, None] if value.ndim == 1 else value


def corotated_stress(F: Mat2, mu: Value, lam: Value, J: Tensor | None = None) -> Sym2:
    """Kirchhoff stress of the fixed corotated solid, 2 mu (F - R) F^T + lam J (J - 1) I (Stomakhin et al., 2012).

    J is det F unless it is given.
    """
    a, b, c, d = F
    r = polar(F)
    e, f, g, h = a - r[0], b - r[1], c - r[2], d - r[3]
    J = det(F) if J is None else J
    pressure = lam * (J * (J - 1.0))
    mu2 = 2.0 * mu
    return mu2 * (e * a + f * b) + pressure, mu2 * (e * c + f * d), mu2 * (g * c + h * d) + pressure


def corotated_energy(F: Mat2, mu: Value, lam: Value, J: Tensor | None = None) -> Tensor:
    """Energy mu |F - R|^2 + lam/2 (J - 1)^2 whose derivative is :func:`corotated_stress`; J is det F unless given."""
    distance = sum((f - r).square() for f, r in zip(F, polar(F), strict=True))
    return mu * distance + 0.5 * lam * ((det(F) if J is None else J) - 1.0).square()


def yield_values(limit: Value) -> tuple[Value, Value, Value, Value]:
    """What :func:`von_mises_return` needs to know of the principal stretches at yield.

    From exp(d) - 1 with their logarithms' difference d, for the digits that the ratio alone would lose in small d.

    Args:
        limit: Yield stress / (2 mu).

    Returns:
        Difference over sum of the stretches, their ratio, and sum and difference of its square root and the inverse.
    """
    excess = 2.0 * (limit * limit - NORM_EPSILON)
    growth: Value
    root: Value
    if isinstance(excess, Tensor):
        difference = excess.clamp(NORM_EPSILON, LARGEST_DIFFERENCE**2).sqrt()
        growth, root = difference.expm1(), (0.5 * difference).exp()
    else:
        number = math.sqrt(min(max(excess, NORM_EPSILON), LARGEST_DIFFERENCE**2))
        growth, root = math.expm1(number), math.exp(0.5 * number)
    return growth / (growth + 2.0), growth + 1.0, root + 1.0 / root, growth / root


def von_mises_return(F: Mat2, limit: Value) -> Mat2:
    """Closest point on the von Mises yield surface in principal logarithmic strains.

    With e_1 >= e_2 the logarithms of the principal stretches (floored at 0.05), the deviator has the norm
    ``sqrt((e_1 - e_2)^2 / 2 + 1e-8)``. Where it exceeds ``limit`` = yield stress / (2 mu), the difference e_1 - e_2 is
    brought back to its value at yield and the volume is kept: plastic flow is isochoric. Elsewhere F is returned as it
    came. Without logarithm or SVD: the test compares stretch ratios, and sum and difference of the returned stretches
    rescale the rotation and the reflection part of F (see ``torchmpm.linalg``).

    The derivative jumps at the yield surface; exactly on it this returns the elastic side.

    Args:
        F: Trial deformation gradient, planes (B, N).
        limit: Yield stress / (2 mu), a number or broadcastable to (B, N).
    """
    slope, ratio, plus, minus = yield_values(limit)
    p, q, r, s = split(F)
    rotation, reflection = p.square() + q.square(), r.square() + s.square()
    proper = rotation >= reflection
    large, small = torch.where(proper, rotation, reflection), torch.where(proper, reflection, rotation)
    beyond = small > slope * slope * large
    # Elsewhere harmless numbers go through the square roots, so that no infinite derivative meets a zero.
    total = torch.where(beyond, large, 1.0).sqrt()
    difference = torch.where(beyond, small, 0.25).sqrt()
    major = (0.5 * (total + difference)).clamp_min(STRETCH_FLOOR)
    minor = (0.5 * (total - difference)).clamp_min(STRETCH_FLOOR)
    yields = beyond & (major > minor * ratio)
    mean = (major * minor).sqrt()
    grow_total, grow_difference = mean * plus / total, mean * minus / difference
    of_rotation = 0.5 * torch.where(proper, grow_total, grow_difference)
    of_reflection = 0.5 * torch.where(proper, grow_difference, grow_total)
    return (
        torch.where(yields, p * of_rotation + r * of_reflection, F[0]),
        torch.where(yields, s * of_reflection - q * of_rotation, F[1]),
        torch.where(yields, q * of_rotation + s * of_reflection, F[2]),
        torch.where(yields, p * of_rotation - r * of_reflection, F[3]),
    )


def clamp_stretches(F: Mat2, low: Value, high: Value, shear_cutoff: float = 0.0) -> tuple[Mat2, Tensor]:
    """Bring both principal stretches of F into [low, high].

    No SVD: sum and difference of the stretches rescale the rotation and the reflection part of F (see
    ``torchmpm.linalg``), the larger of which holds the orthogonal factor R of F = R S.

    Args:
        F: Trial deformation gradient, planes (B, N).
        low: Smallest stretch, broadcastable to (B, N).
        high: Largest stretch.
        shear_cutoff: An off-diagonal entry of S below this is dropped first, as in the reference implementation.

    Returns:
        The new F, and by how much its area |det F| was reduced, |det F| before over after, (B, N).
    """
    p, q, r, s = split(F)
    rotation, reflection = p.square() + q.square(), r.square() + s.square()
    proper = rotation >= reflection
    m1, m2 = torch.where(proper, p, r), torch.where(proper, q, s)  # the larger part: R and the sum of stretches
    n1, n2 = torch.where(proper, r, p), torch.where(proper, s, q)  # the smaller part: their difference
    square = torch.where(proper, rotation, reflection)
    empty = square == 0
    total = torch.where(empty, 1.0, square).sqrt()
    cos, sin = torch.where(empty, 1.0, m1 / total), m2 / total
    total = torch.where(empty, 0.0, total)
    if shear_cutoff:
        along = n1 * cos + n2 * sin
        drop = (n2 * cos - n1 * sin).abs() < 2.0 * shear_cutoff
        n1, n2 = torch.where(drop, along * cos, n1), torch.where(drop, along * sin, n2)
    square = n1.square() + n2.square()
    round_ = square == 0  # equal stretches: any axes are principal, and no square root is taken of zero
    difference = torch.where(round_, 0.0, torch.where(round_, 1.0, square).sqrt())
    stretches = 0.5 * (total + difference), 0.5 * (total - difference)
    major, minor = (_clamp(stretch, low, high) for stretch in stretches)
    # Where stretches are equal the ratio multiplies zeros; its value is what a small difference would be scaled by.
    kept = ((stretches[0] >= low) & (stretches[0] <= high)).to(total.dtype)
    ratio = torch.where(round_, kept, (major - minor) / torch.where(round_, 1.0, difference))
    m1, m2, n1, n2 = (major + minor) * cos, (major + minor) * sin, ratio * n1, ratio * n2
    p, q, r, s = (torch.where(proper, a, b) for a, b in ((m1, n1), (m2, n2), (n1, m1), (n2, m2)))
    squeezed = stretches[0] * stretches[1] / (major * minor)
    return (0.5 * (p + r), 0.5 * (s - q), 0.5 * (q + s), 0.5 * (p - r)), squeezed


def _clamp(stretch: Tensor, low: Value, high: Value) -> Tensor:
    """Clamp whose derivative at the bounds is that of the inside."""
    return torch.where(stretch < low, low, torch.where(stretch > high, high, stretch))


def _check_not_negative(material: Elastic, *names: str) -> None:
    for name in names:
        checks.value(name, getattr(material, name), least=0.0)


@dataclass(frozen=True, eq=False)
class Elastic:
    """Fixed corotated elastic solid. A constant is a number or a tensor of shape (), (B,) or (B, N).

    Attributes:
        mu: Second Lame parameter (shear modulus), Pa.
        lam: First Lame parameter, Pa; negative for a negative Poisson's ratio, but not below -mu.

    Raises:
        ValueError: ``mu`` is negative, or ``lam`` below -mu.
    """

    mu: Value
    lam: Value

    def __post_init__(self) -> None:
        _check_not_negative(self, "mu")
        checks.value("lam", self.lam)
        if not isinstance(self.mu, Tensor) and not isinstance(self.lam, Tensor) and self.lam < -self.mu:
            raise ValueError(f"lam must be at least -mu, {-self.mu}, got {self.lam}")

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Nothing flows: the planes (B, N) of the trial ``F``, and ``Jp`` (B, N), are kept."""
        return F, Jp

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Kirchhoff stress at ``F``, planes (B, N), Pa; see :func:`corotated_stress`. ``Jp`` only gives the shape."""
        return corotated_stress(F, column(self.mu, Jp, "mu"), column(self.lam, Jp, "lam"))

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Stored energy per unit volume at ``F``, (B, N), J/m^2; ``Jp`` only gives the shape."""
        return corotated_energy(F, column(self.mu, Jp, "mu"), column(self.lam, Jp, "lam"))

    def stiffness(self) -> Value:
        """Largest stress per strain in undeformed matter, Pa: 2 (mu + lam), that of a change of volume.

        Of shear, 2 mu, where lam is negative. A number, or where the constants are tensors one of shape (), (B, 1) or
        (B, N).
        """
        mu, lam = spread(self.mu), spread(self.lam)
        if isinstance(mu, Tensor) or isinstance(lam, Tensor):
            mu, lam = (torch.as_tensor(value, dtype=torch.float64, device="cpu") for value in (mu, lam))
            return 2.0 * torch.where(lam < -mu, -torch.inf, mu + lam.clamp_min(0.0))
        return 2.0 * (mu + max(lam, 0.0))


@dataclass(frozen=True, eq=False)
class VonMises(Elastic):
    """Fixed corotated solid that flows plastically once its deviatoric strain reaches a limit.

    The robot material of DittoGym (Huang et al., ICLR 2024): soft enough to be driven by muscles, plastic enough to
    keep a new shape. A constant is a number or a tensor of shape (), (B,) or (B, N).

    Attributes:
        mu: Second Lame parameter, Pa.
        lam: First Lame parameter, Pa.
        yield_stress: von Mises yield stress, Pa; the deviatoric strain at yield is ``yield_stress / (2 mu)``.

    Raises:
        ValueError: ``mu`` is not positive, ``lam`` below -mu, or the yield stress negative.
    """

    yield_stress: Value

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.value("mu", self.mu, above=0.0)  # strains at yield are counted in it
        _check_not_negative(self, "yield_stress")

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Isochoric return of ``F`` to the yield surface, planes (B, N), and ``Jp`` (B, N) as it is.

        See :func:`von_mises_return`.
        """
        limit = column(self.yield_stress, Jp, "yield_stress") / (2.0 * column(self.mu, Jp, "mu"))
        return von_mises_return(F, limit), Jp


@dataclass(frozen=True, eq=False)
class Soil(Elastic):
    """Loose ground: stretches leave a narrow range plastically, and compaction hardens.

    Snow plasticity (Stomakhin et al., "A material point method for snow simulation", 2013) with the values of
    DittoGym's DIG. The plastic volume ratio Jp collects the area that stretches lost to their bounds; the elastic
    constants are multiplied by ``exp(hardening (1 - Jp))`` within ``hardening_range``, with Jp of the substep before.
    A constant is a number or a tensor of shape (), (B,) or (B, N).

    Attributes:
        mu: Second Lame parameter at Jp = 1, Pa.
        lam: First Lame parameter at Jp = 1, Pa.
        compression: A principal stretch is kept above 1 - compression.
        stretch: And below 1 + stretch.
        hardening: Exponent.
        hardening_range: Bounds of the factor on the elastic constants.
        shear_cutoff: Shear stretch below this is forgotten in every substep, so the ground creeps. 1e-5 is the
            threshold of the reference implementation's singular value decomposition, and part of DIG; 0 turns it off.

    Raises:
        ValueError: A value is negative, ``compression`` is not below 1, or ``hardening_range`` is not a range.
    """

    compression: Value = 0.025
    stretch: Value = 0.0045
    hardening: Value = 10.0
    hardening_range: tuple[float, float] = (0.1, 5.0)
    shear_cutoff: float = 1e-5

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_not_negative(self, "compression", "stretch", "hardening")
        checks.number("shear_cutoff", self.shear_cutoff, least=0.0)
        if not isinstance(self.compression, Tensor) and not self.compression < 1:
            raise ValueError(f"compression must be below 1, got {self.compression}")
        given = self.hardening_range
        numbers = isinstance(given, tuple) and len(given) == 2 and all(isinstance(bound, Real) for bound in given)
        if not numbers or not 0 <= given[0] <= given[1]:
            raise ValueError(f"hardening_range must be (low, high) with 0 <= low <= high, got {given!r}")

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Bring the principal stretches of ``F`` into their range; its planes (B, N), and the new ``Jp`` (B, N).

        See :func:`clamp_stretches`.
        """
        low, high = 1.0 - column(self.compression, Jp, "compression"), 1.0 + column(self.stretch, Jp, "stretch")
        F, squeezed = clamp_stretches(F, low, high, self.shear_cutoff)
        return F, (Jp * squeezed).clamp_max(LARGEST_JP)

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Kirchhoff stress at ``F`` and ``Jp``, planes (B, N), Pa; an inverted element rests in its mirrored shape."""
        mu, lam = self._hardened(Jp)
        return corotated_stress(F, mu, lam, det(F).abs())

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Stored energy per unit volume at ``F`` and ``Jp``, (B, N), J/m^2."""
        mu, lam = self._hardened(Jp)
        return corotated_energy(F, mu, lam, det(F).abs())

    def stiffness(self) -> Value:
        """As that of :class:`Elastic`, at Jp = 1, Pa: a number or a tensor of shape (), (B, 1) or (B, N)."""
        low, high = self.hardening_range
        return min(max(1.0, low), high) * super().stiffness()

    def _hardened(self, Jp: Tensor) -> tuple[Value, Value]:
        low, high = self.hardening_range
        exponent = column(self.hardening, Jp, "hardening") * (1.0 - Jp)
        if high > 0:  # beyond it an exponential could overflow, whose derivative is no number even where it is clamped
            exponent = exponent.clamp_max(math.log(high) + 0.01)
        factor = exponent.exp().clamp(low, high)
        return factor * column(self.mu, Jp, "mu"), factor * column(self.lam, Jp, "lam")
