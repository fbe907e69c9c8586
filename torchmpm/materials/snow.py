"""Snow plasticity (Stomakhin et al., "A material point method for snow simulation", 2013)."""

import math
from dataclasses import dataclass
from numbers import Real

import torch
from torch import Tensor

from torchmpm import checks, tree
from torchmpm.materials.base import Value, broadcast_plane, check_not_negative
from torchmpm.materials.elastic import Elastic, corotated_energy, corotated_stress
from torchmpm.materials.linalg import Mat2, PolarParts, Sym2, det, direction, from_polar_parts, polar_parts, safe_sqrt

#: Change of displacement gradient in a substep, ``dt |C|``, beyond which snow passes no derivative on.
LARGEST_STRAIN = 0.03
#: Jp stays below this. A grain that is pulled apart forever reaches the least stiffness, a tenth, at Jp = 1.23; without
#: the bound its Jp would grow until it overflows, and spoil gradients.
LARGEST_JP = 1e30


def snow_return(F: Mat2, low: Value, high: Value, shear_cutoff: float = 0.0) -> tuple[Mat2, Tensor]:
    """Bring both principal stretches of F into [low, high]; the new F, and |det F| before over after, (B, N).

    Sum and difference of the new stretches rescale the two parts of F (see ``torchmpm.materials.linalg``). First, an
    off-diagonal entry of S in F = R S below ``shear_cutoff`` is dropped, as in the reference implementation.
    """
    parts = polar_parts(F)
    total, cos, sin = direction(parts)
    n1, n2 = parts.n1, parts.n2
    if shear_cutoff:
        along = n1 * cos + n2 * sin
        drop = (n2 * cos - n1 * sin).abs() < 2.0 * shear_cutoff
        n1, n2 = torch.where(drop, along * cos, n1), torch.where(drop, along * sin, n2)
    square = n1.square() + n2.square()
    isotropic = square == 0  # equal stretches: any axes are principal, and no square root is taken of zero
    difference = safe_sqrt(square)
    stretches = 0.5 * (total + difference), 0.5 * (total - difference)
    major, minor = (_clamp(stretch, low, high) for stretch in stretches)
    # Where both stretches are kept, the ratio is 1. Its quotient, and even more the derivative, would lose all digits
    # where they are nearly equal, as in soil at rest.
    kept = (stretches[0] <= high) & (stretches[1] >= low)
    ratio = 0.5 * torch.where(kept, 1.0, (major - minor) / torch.where(kept | isotropic, 1.0, difference))
    mean = 0.5 * (major + minor)
    returned = from_polar_parts(PolarParts(mean * cos, mean * sin, ratio * n1, ratio * n2, parts.proper))
    return returned, stretches[0] * stretches[1] / (major * minor)


def _clamp(stretch: Tensor, low: Value, high: Value) -> Tensor:
    """Clamp whose derivative at the bounds is that of the inside."""
    return torch.where(stretch < low, low, torch.where(stretch > high, high, stretch))


@tree.register
@dataclass(frozen=True, eq=False)
class Snow(Elastic):
    """Snow or loose ground (Stomakhin et al., "A material point method for snow simulation", 2013).

    The principal stretches of F are elastic within a narrow range; what exceeds it becomes plastic deformation. The
    plastic volume ratio Jp is multiplied by the ratio of the area before this correction to that after it, so that it
    falls below 1 under compaction. The stress is that of :class:`torchmpm.Elastic`, with constants that are multiplied
    by ``exp(hardening (1 - Jp))``, clipped to ``hardening_range``, with Jp of the substep before. The default values
    are those of the soil in DittoGym's task DIG. A constant is a number or a tensor of shape (), (B,), (B, 1),
    (B, count) or (1, count) with the body's count.

    Gradients are deliberately not exact where a substep does not resolve the motion. In the forward direction, plastic
    flow bounds such motion, but its exact derivative grows in every substep, until it overflows. So where hardened snow
    is stiffer than substeps of this length allow (see :meth:`torchmpm.Solver.stable_dt`), its stress is differentiated
    with respect to F as if it had the largest stiffness that they do allow. And grains whose affine matrix C is so
    large that ``dt |C|`` exceeds 0.03 (Frobenius norm), such as grains that spin in the air, pass no derivative on to
    earlier substeps. States are not affected, nor are gradients elsewhere. ``exact_gradients=True`` turns both limits
    off.

    Attributes:
        mu: Second Lame parameter at Jp = 1, Pa, not negative.
        lam: First Lame parameter at Jp = 1, Pa, at least -mu.
        compression: Principal stretches are kept above ``1 - compression``; dimensionless, from 0 to below 1.
        stretch: Principal stretches are kept below ``1 + stretch``; dimensionless, not negative.
        hardening: Factor in the exponent; dimensionless, not negative.
        hardening_range: Lowest and highest factor on the elastic constants.
        shear_cutoff: An off-diagonal entry of S in the polar decomposition ``F = R S`` whose magnitude is below this is
            set to zero in every substep, so that the material creeps. 1e-5 is the threshold of the singular value
            decomposition in the reference implementation, and part of DIG; 0 turns this off.
        exact_gradients: Whether a solver also differentiates the motion that its substeps do not resolve.

    Raises:
        ValueError: A value other than ``lam`` is negative, ``lam`` is below -mu (for a tensor: when a solver with
            ``allow_unstable=False`` is made), a value is not finite, ``compression`` is not below 1,
            ``hardening_range`` is not a tuple (low, high) with 0 <= low <= high, or ``exact_gradients`` is not True or
            False.
        TypeError: A tensor is not dense.
    """

    compression: Value = 0.025
    stretch: Value = 0.0045
    hardening: Value = 10.0
    hardening_range: tuple[float, float] = (0.1, 5.0)
    shear_cutoff: float = 1e-5
    exact_gradients: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_not_negative(self, "compression", "stretch", "hardening")
        checks.number("shear_cutoff", self.shear_cutoff, least=0.0)
        checks.flag("exact_gradients", self.exact_gradients)
        checks.entries("compression", self.compression, below=1.0)
        given = self.hardening_range
        numbers = isinstance(given, tuple) and len(given) == 2 and all(isinstance(bound, Real) for bound in given)
        if not numbers or not 0 <= given[0] <= given[1]:
            raise ValueError(f"hardening_range must be (low, high) with 0 <= low <= high, got {given!r}")

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """Bring the principal stretches of ``F`` into their range; its components (B, N), and the new ``Jp`` (B, N).

        See :func:`snow_return`.
        """
        low = 1.0 - broadcast_plane(self.compression, Jp, "compression")
        high = 1.0 + broadcast_plane(self.stretch, Jp, "stretch")
        F, reduction = snow_return(F, low, high, self.shear_cutoff)
        return F, (Jp * reduction).clamp_max(LARGEST_JP)

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Kirchhoff stress at ``F`` and ``Jp``, (B, N) each, Pa; an inverted element rests in its mirrored shape."""
        mu, lam = self.hardened(Jp)
        return corotated_stress(F, mu, lam, det(F).abs())

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Stored energy per unit volume at ``F`` and ``Jp``, (B, N), J/m^2."""
        mu, lam = self.hardened(Jp)
        return corotated_energy(F, mu, lam, det(F).abs())

    def stiffness(self) -> Value:
        """As that of :class:`Elastic`, at Jp = 1, Pa."""
        low, high = self.hardening_range
        return min(max(1.0, low), high) * super().stiffness()

    def resolved_stress(self, F: Mat2, Jp: Tensor, stable: Value) -> Sym2:
        """Return the stress, but with the derivative in F of a material of limited stiffness.

        All other derivatives, that in Jp among them, are exact.

        Args:
            F: Components (B, N) of the deformation gradient after the return map.
            Jp: (B, N) plastic volume ratio before it.
            stable: Largest stiffness, Pa; a number or a tensor that broadcasts to (B, N).
        """
        tau = self.stress(F, Jp)
        if self.exact_gradients:
            return tau
        with torch.no_grad():
            mu, lam = self.hardened(Jp)
            excess = (1.0 - stable / (2.0 * (mu + lam.clamp_min(0.0)))).clamp_min(0.0)
        removed = corotated_stress(F, excess * mu, excess * lam, det(F).abs())
        xx, xy, yy = (value - (part - part.detach()) for value, part in zip(tau, removed, strict=True))
        return xx, xy, yy

    def unresolved(self, C: Mat2, dt: float) -> Tensor | None:
        """Return which grains deform too much in a substep to pass a derivative on.

        Args:
            C: Components (B, N) of the affine matrices, 1/s.
            dt: Duration of a substep, s.

        Returns:
            (B, N) bool; ``None`` if all of them pass derivatives on.
        """
        if self.exact_gradients:
            return None
        c0, c1, c2, c3 = C
        return c0.square() + c1.square() + c2.square() + c3.square() > (LARGEST_STRAIN / dt) ** 2

    def hardened(self, Jp: Tensor) -> tuple[Tensor, Tensor]:
        """Lame parameters mu and lam at ``Jp`` (B, N), Pa."""
        low, high = self.hardening_range
        exponent = broadcast_plane(self.hardening, Jp, "hardening") * (1.0 - Jp)
        if high > 0:  # beyond it the exponential could overflow, and its derivative would be NaN even where clamped
            exponent = exponent.clamp_max(math.log(high) + 0.01)
        # At equal bounds, where the factor is constant, clamp would pass a derivative on.
        factor = exponent.exp().clamp(low, high) if low < high else low + 0.0 * exponent
        return factor * broadcast_plane(self.mu, Jp, "mu"), factor * broadcast_plane(self.lam, Jp, "lam")
