"""Pieces that the rewards of all tasks are made of (DittoGym, appendix on tasks)."""

from __future__ import annotations

import torch
from torch import Tensor

from dittogym.spec import Measurement
from torchmpm import ParticleState

#: The spread of a robot is not counted beyond this, m.
SPLIT_CAP = 0.2


def signed_quadratic(z: Tensor, k: float) -> Tensor:
    """``sign(z) (2 z)^2 + k z``: linear for small, quadratic for large deviations."""
    return 4.0 * z * z.abs() + k * z


def nearest(x: Tensor, point: Tensor, share: float) -> Tensor:
    """A share of the particles ``x`` (B, N, 2), those nearest to ``point`` (B, 2), less the widest: indices (B, K)."""
    distance = (x - point[:, None]).square().sum(-1)
    return drop_widest(distance.topk(share_of(share, x), largest=False).indices, x)


def share_of(share: float, x: Tensor) -> int:
    """How many of the particles ``x`` (B, N, 2) a share is, at least one."""
    return max(1, round(share * x.shape[1]))


def drop_widest(index: Tensor, x: Tensor) -> Tensor:
    """Leave the particle with the largest |x| out of ``index`` (B, K), unless it is the only one: (B, K - 1)."""
    batch, count = index.shape
    if count == 1:
        return index
    widest = x[..., 0].abs().gather(1, index).argmax(1, keepdim=True)
    kept = torch.arange(count, device=index.device) != widest
    return index[kept].view(batch, count - 1)


def pick(x: Tensor, index: Tensor) -> Tensor:
    """Positions (B, K, 2) of the particles ``index`` (B, K) among ``x`` (B, N, 2)."""
    return x.gather(1, index[..., None].expand(-1, -1, 2))


def action_cost(field: Tensor) -> Tensor:
    """Sum over both muscle directions of the Frobenius norm of the actuation on the patch (B, 2, P, P); (B,)."""
    return field.flatten(2).norm(dim=2).sum(1)


def measure(particles: ParticleState, robot: int) -> Measurement:
    """Averages over the robot (the first ``robot`` particles) and, if there are more, over the object."""
    x, v = particles.x, particles.v
    com = x[:, :robot].mean(1)
    variance = (x[:, :robot] - com[:, None]).square().mean(1)  # several times faster than Tensor.var
    bodies = [com, v[:, :robot].mean(1), variance.sum(-1).sqrt()]
    if robot < x.shape[1]:
        bodies += [x[:, robot:].mean(1), v[:, robot:].mean(1)]
    return Measurement(*bodies)


def split_penalty(split: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """Penalty ``-(20 s)^2`` and end of the episode once the spread s (B,) exceeds ``limit``.

    Returns:
        Penalty (B,) and termination (B,) bool.
    """
    torn = split > limit
    return -(20.0 * split.clamp_max(SPLIT_CAP)).square() * torn, torn
