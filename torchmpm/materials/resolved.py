"""Derivatives of snow, limited to the motion that a substep resolves; :class:`torchmpm.Snow` says why."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchmpm.materials.base import broadcast_plane
from torchmpm.materials.body import Body
from torchmpm.materials.linalg import Mat2
from torchmpm.materials.snow import Snow

#: Change of displacement gradient in a substep, ``dt |C|``, beyond which snow passes no derivative on.
LARGEST_STRAIN = 0.03


def is_limited(body: Body) -> bool:
    """Whether derivatives through a body are limited."""
    return isinstance(body.material, Snow) and not body.material.exact_gradients


def resolved_tangent(body: Body, F: Mat2, Jp: Tensor, h: float, dt: float) -> Mat2:
    """The planes ``F`` (B, N), through which the derivative of a stress is that of a stiffness stable at ``dt``.

    For a stiffness k of snow at ``Jp`` above the largest stable one, ``(h / dt)^2 m / V``, derivatives are scaled by
    the ratio of the two. The values are those of ``F``.
    """
    material = body.material
    if not is_limited(body):
        return F
    assert isinstance(material, Snow)
    with torch.no_grad():
        mass, volume = (broadcast_plane(getattr(body, name), Jp, name) for name in ("mass", "volume"))
        mu, lam = (torch.as_tensor(value) for value in material.hardened(Jp))
        share = (h / dt) ** 2 * mass / (volume * 2.0 * (mu + lam.clamp_min(0.0)))
        share = share.clamp_max(1.0)
    a, b, c, d = (torch.lerp(entry.detach(), entry, share) for entry in F)
    return a, b, c, d


def detach_unresolved(bodies: Sequence[Body], planes: tuple[Tensor, ...], dt: float) -> tuple[Tensor, ...]:
    """The 13 planes (B, N) of a state, without the graph of snow with a velocity gradient beyond LARGEST_STRAIN / dt."""
    limited = [is_limited(body) for body in bodies]
    if not any(limited):
        return planes
    with torch.no_grad():
        counts = torch.tensor([body.count for body in bodies], device=planes[0].device)
        snow = torch.tensor(limited, device=planes[0].device).repeat_interleave(counts)
        rate = sum(entry.square() for entry in planes[4:8])
        unresolved = snow & (rate > (LARGEST_STRAIN / dt) ** 2)
    return tuple(torch.where(unresolved, plane.detach(), plane) for plane in planes)
