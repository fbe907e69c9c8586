"""Derivatives of snow, limited to the motion that a substep resolves; :class:`torchmpm.Snow` says why."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmpm.materials.base import broadcast_plane, check_stress
from torchmpm.materials.body import Body
from torchmpm.materials.elastic import corotated_stress
from torchmpm.materials.linalg import Mat2, Sym2, det
from torchmpm.materials.snow import Snow

#: Change of displacement gradient in a substep, ``dt |C|``, beyond which snow passes no derivative on.
LARGEST_STRAIN = 0.03


def is_limited(body: Body) -> bool:
    """Whether derivatives through a body are limited."""
    return isinstance(body.material, Snow) and not body.material.exact_gradients


def resolved_stress(body: Body, F: Mat2, Jp: Tensor, h: float, dt: float) -> Sym2:
    """Stress of a body at ``F`` and ``Jp``, planes (B, N), Pa; that of snow has a limited derivative with respect to F.

    Where the stiffness of hardened snow exceeds the largest one for which substeps of ``dt`` are stable,
    ``(h / dt)^2 m / V``, the derivative is that of the stable one. All other derivatives are exact.
    """
    material = body.material
    tau = check_stress(material, material.stress(F, Jp), Jp)
    if not isinstance(material, Snow) or material.exact_gradients:
        return tau
    with torch.no_grad():
        mass, volume = (broadcast_plane(getattr(body, name), Jp, name) for name in ("mass", "volume"))
        mu, lam = material.hardened(Jp)
        stable = (h / dt) ** 2 * mass / volume
        excess = (1.0 - stable / (2.0 * (mu + lam.clamp_min(0.0)))).clamp_min(0.0)
    removed = corotated_stress(F, excess * mu, excess * lam, det(F).abs())
    xx, xy, yy = (value - (part - part.detach()) for value, part in zip(tau, removed, strict=True))
    return xx, xy, yy


def detach_unresolved(bodies: Sequence[Body], planes: tuple[Tensor, ...], dt: float) -> tuple[Tensor, ...]:
    """The 13 planes (B, N) of a state, cut from the graph where snow has ``|C|`` beyond ``LARGEST_STRAIN / dt``."""
    if not any(is_limited(body) for body in bodies):
        return planes
    with torch.no_grad():
        c0, c1, c2, c3 = planes[4:8]
        fast = c0.square() + c1.square() + c2.square() + c3.square() > (LARGEST_STRAIN / dt) ** 2
        snow = torch.cat([fast.new_full((body.count,), is_limited(body)) for body in bodies])
        unresolved = snow & fast
    return tuple(torch.where(unresolved, plane.detach(), plane) for plane in planes)
