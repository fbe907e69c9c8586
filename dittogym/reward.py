"""Pieces that the rewards of all tasks are made of (DittoGym, appendix on tasks)."""

from __future__ import annotations

from torch import Tensor

from dittogym.spec import Measurement
from torchmpm import ParticleState

#: The spread of a robot is not counted beyond this, m.
SPLIT_CAP = 0.2


def signed_quadratic(z: Tensor, k: float) -> Tensor:
    """``sign(z) (2 z)^2 + k z``: linear for small, quadratic for large deviations."""
    return 4.0 * z * z.abs() + k * z


def action_cost(field: Tensor) -> Tensor:
    """Sum over both muscle directions of the Frobenius norm of the actuation on the patch (B, 2, P, P); (B,)."""
    return field.flatten(2).norm(dim=2).sum(1)


def measure(particles: ParticleState, robot: int) -> Measurement:
    """Averages over the robot (the first ``robot`` particles) and, if there are more, over the object."""
    x, v = particles.x, particles.v
    variance = x[:, :robot].var(dim=1, correction=0)
    bodies = [x[:, :robot].mean(1), v[:, :robot].mean(1), variance.sum(-1).sqrt()]
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
