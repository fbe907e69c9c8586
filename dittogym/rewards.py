"""Pieces that the rewards of all tasks are made of (DittoGym, appendix on tasks)."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

from dittogym.spec import Measurement
from torchmpm import ParticleState, checks

#: The spread of a robot is not counted beyond this, m.
SPLIT_CAP = 0.2
#: Soft limits set in over this share of their value.
SOFTNESS = 0.05
#: The nearest particles fade out over this distance where the choice is soft, m.
FADE = 0.005


def signed_quadratic(z: Tensor, k: float) -> Tensor:
    """``sign(z) (2 z)^2 + k z``: linear for small, quadratic for large deviations."""
    return 4.0 * z * z.abs() + k * z


def limited(
    z: Tensor, low: float | None = None, high: float | None = None, *, soft: bool = False, width: float | None = None
) -> Tensor:
    """Bring ``z`` into [low, high]; ``None`` leaves an end open.

    Soft, a limit l sets in over the width w: ``w ln(1 + exp((z - l) / w))`` is taken off. The result differs by at most
    w ln 2, at the limit, where its slope is 1/2.

    Args:
        z: Of any shape.
        low: Least value.
        high: Largest value.
        soft: For gradients.
        width: w, in units of ``z``; ``None``: a twentieth of the limit's size, for a limit of 0 of the other's.

    Raises:
        ValueError: ``width`` is not positive, or is needed and not given: all limits are 0.
    """
    if not soft:
        return z.clamp(low, high)
    if width is not None:
        checks.number("width", width, above=0.0)
    largest = max((abs(limit) for limit in (low, high) if limit is not None), default=0.0)
    for limit, sign in ((high, 1.0), (low, -1.0)):
        if limit is None:
            continue
        w = width or SOFTNESS * (abs(limit) or largest)
        if not w:
            raise ValueError(f"width must be given where all limits are 0, got None with low {low}, high {high}")
        z = z - sign * w * softplus(sign * (z - limit) / w)
    return z


def beyond(z: Tensor, width: float, *, soft: bool = False) -> Tensor:
    """1 where ``z`` is positive, else 0; soft, a sigmoid that reaches 0.98 and 0.02 at four times the ``width``."""
    return torch.sigmoid(z / width) if soft else (z > 0).to(z.dtype)


def distance(x: Tensor, point: Tensor) -> Tensor:
    """Of particles ``x`` (B, N, 2) from ``point`` (B, 2), (B, N), m; its derivative is 0 where they coincide."""
    squared = _squared_distance(x, point)
    same = squared == 0
    return torch.where(same, 0.0, torch.where(same, 1.0, squared).sqrt())


def _squared_distance(x: Tensor, point: Tensor) -> Tensor:
    # By component: a state keeps components apart, and Tensor.norm over its last axis takes a hundred times as long.
    return (x[..., 0] - point[:, :1]).square() + (x[..., 1] - point[:, 1:]).square()


def mean_over_nearest(values: Tensor, x: Tensor, point: Tensor, share: float, *, soft: bool = False) -> Tensor:
    """Mean of ``values`` over the particles that ``nearest`` chooses.

    Soft, particles fade out around the distance within which there are as many, over ``FADE``, and the choice is
    differentiated too; the widest particle is not left out.

    Args:
        values: (B, N, K).
        x: (B, N, 2) positions of the particles, m.
        point: (B, 2), m.
        share: How many, as a share of all.
        soft: For gradients.

    Returns:
        (B, K).
    """
    if not soft:
        index = nearest(x.detach(), point.detach(), share)
        return values.gather(1, index[..., None].expand(-1, -1, values.shape[2])).mean(1)
    squared = _squared_distance(x, point)
    edge = squared.topk(share_of(share, x), largest=False).values[:, -1:]
    width = 2.0 * FADE * edge.clamp_min(FADE**2).sqrt()
    weight = torch.sigmoid((edge - squared) / width)[..., None]
    return (weight * values).sum(1) / weight.sum(1)


def nearest(x: Tensor, point: Tensor, share: float) -> Tensor:
    """A share of the particles ``x`` (B, N, 2), those nearest to ``point`` (B, 2), less the widest: indices (B, K)."""
    return drop_widest(_squared_distance(x, point).topk(share_of(share, x), largest=False).indices, x)


def share_of(share: float, x: Tensor) -> int:
    """How many of the particles ``x`` (B, N, 2) a share is, at least one."""
    return max(1, round(share * x.shape[1]))


def drop_widest(index: Tensor, x: Tensor) -> Tensor:
    """Leave the particle with the largest |x| out of ``index`` (B, K), unless it is the only one: (B, K - 1)."""
    batch, count = index.shape
    if count == 1:
        return index
    widest = x[..., 0].abs().gather(1, index).argmax(1, keepdim=True)
    others = torch.arange(count - 1, device=index.device).expand(batch, -1)
    return index.gather(1, others + (others >= widest))


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
    spread = variance.sum(-1)
    alone = spread == 0  # a single particle: no slope, and none is divided by
    split = torch.where(alone, 0.0, torch.where(alone, 1.0, spread).sqrt())
    bodies = [com, v[:, :robot].mean(1), split]
    if robot < x.shape[1]:
        bodies += [x[:, robot:].mean(1), v[:, robot:].mean(1)]
    return Measurement(*bodies)


def split_penalty(split: Tensor, limit: float, *, soft: bool = False) -> tuple[Tensor, Tensor]:
    """Penalty ``-(20 s)^2`` and end of the episode once the spread s (B,) exceeds ``limit``.

    Soft, the penalty sets in over a width of ``limit / 20``, and goes on growing beyond :data:`SPLIT_CAP`.

    Returns:
        Penalty (B,) and termination (B,) bool.
    """
    counted = split if soft else split.clamp_max(SPLIT_CAP)
    return -(20.0 * counted).square() * beyond(split - limit, SOFTNESS * limit, soft=soft), split > limit
