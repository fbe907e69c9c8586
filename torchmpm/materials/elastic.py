"""Fixed corotated elasticity (Stomakhin et al., "Energetically consistent invertible elasticity", 2012)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm import checks, tree
from torchmpm.materials.base import Value, broadcast_plane, check_not_negative, detached_column
from torchmpm.materials.linalg import Mat2, Sym2, det, orthogonal


def corotated_stress(F: Mat2, mu: Value, lam: Value, J: Tensor | None = None) -> Sym2:
    """Kirchhoff stress 2 mu (F - R) F^T + lam J (J - 1) I, components (B, N), Pa; J is det F unless given."""
    a, b, c, d = F
    r = orthogonal(F)
    e, f, g, h = a - r[0], b - r[1], c - r[2], d - r[3]
    J = det(F) if J is None else J
    pressure = lam * (J * (J - 1.0))
    mu2 = 2.0 * mu
    return mu2 * (e * a + f * b) + pressure, mu2 * (e * c + f * d), mu2 * (g * c + h * d) + pressure


def corotated_energy(F: Mat2, mu: Value, lam: Value, J: Tensor | None = None) -> Tensor:
    """Energy mu |F - R|^2 + lam/2 (J - 1)^2, (B, N), J/m^2; :func:`corotated_stress` is its derivative times F^T."""
    distance = sum((f - r).square() for f, r in zip(F, orthogonal(F), strict=True))
    return mu * distance + 0.5 * lam * ((det(F) if J is None else J) - 1.0).square()


@tree.register
@dataclass(frozen=True, eq=False)
class Elastic:
    """Fixed corotated elastic solid (Stomakhin et al., "Energetically consistent invertible elasticity", 2012).

    The stored energy per unit of undeformed volume is ``mu |F - R|^2 + lam/2 (J - 1)^2`` with ``J = det F`` and the
    orthogonal factor R of the polar decomposition ``F = R S``, and the Kirchhoff stress is
    ``2 mu (F - R) F^T + lam J (J - 1) I``. A constant is a number or a tensor of shape (), (B,), (B, 1), (B, count) or
    (1, count) with the body's count.

    Attributes:
        mu: Second Lame parameter (shear modulus), Pa, not negative.
        lam: First Lame parameter, Pa; negative for a negative Poisson's ratio, but not below -mu.

    Raises:
        ValueError: ``mu`` is negative, or ``lam`` is below -mu (for a tensor: when a solver with
            ``allow_unstable=False`` is made), or a constant is not finite.
        TypeError: A tensor is not dense.

    Examples:
        >>> import torchmpm
        >>> rubber = torchmpm.Elastic(*torchmpm.lame(young=1e5, poisson=0.3))
    """

    mu: Value
    lam: Value

    def __post_init__(self) -> None:
        check_not_negative(self, "mu")
        checks.value("lam", self.lam)
        if not isinstance(self.mu, Tensor) and not isinstance(self.lam, Tensor) and self.lam < -self.mu:
            raise ValueError(f"lam must be at least -mu, {-self.mu}, got {self.lam}")

    def return_map(self, F: Mat2, Jp: Tensor) -> tuple[Mat2, Tensor]:
        """No plastic flow: the components (B, N) of the trial ``F``, and ``Jp`` (B, N), are kept."""
        return F, Jp

    def stress(self, F: Mat2, Jp: Tensor) -> Sym2:
        """Kirchhoff stress at ``F``, (B, N) each, Pa; see :func:`corotated_stress`. ``Jp`` only gives the shape."""
        return corotated_stress(F, broadcast_plane(self.mu, Jp, "mu"), broadcast_plane(self.lam, Jp, "lam"))

    def energy(self, F: Mat2, Jp: Tensor) -> Tensor:
        """Stored energy per unit volume at ``F``, (B, N), J/m^2; ``Jp`` only gives the shape."""
        return corotated_energy(F, broadcast_plane(self.mu, Jp, "mu"), broadcast_plane(self.lam, Jp, "lam"))

    def stiffness(self) -> Value:
        """Largest ratio of stress to strain in undeformed material, Pa: 2 (mu + lam), under a change of volume.

        It is 2 mu, under shear, where lam is negative. A number, or a tensor of shape (), (B, 1), (B, count) or
        (1, count) where the constants are tensors.
        """
        mu, lam = detached_column(self.mu), detached_column(self.lam)
        if isinstance(mu, Tensor) or isinstance(lam, Tensor):
            mu, lam = (torch.as_tensor(value, dtype=torch.float64, device="cpu") for value in (mu, lam))
            return 2.0 * torch.where(lam < -mu, -torch.inf, mu + lam.clamp_min(0.0))
        return 2.0 * (mu + max(lam, 0.0))
