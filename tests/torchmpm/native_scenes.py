"""Scenes that together reach every branch of the native kernels."""

import math
from dataclasses import replace

import torch
from scenes import FLOOR, lively, normal, robot
from torch import Tensor

from torchmpm import Body, Elastic, ParticleState, Snow, Solver, VelocityRule, VonMises, fixed

#: Rules of every kind and frame, some of which overlap.
RULES = (
    VelocityRule("-y", j=(None, 6), friction=math.inf, i=(None, 8)),
    VelocityRule("-y", j=(None, 7), friction=0.4),
    VelocityRule("+x", i=(10, None), frame="window"),
    VelocityRule("-x", i=(None, 5), friction=0.3),
    *fixed(i=(4, 6), j=(9, 10)),
)


def values(*shape: int, seed: int) -> Tensor:
    """Factors about one."""
    return 1.0 + 0.1 * normal(*shape, seed=seed).abs()


def soil(count: int) -> Body:
    """Loose ground with a cutoff that catches many particles."""
    return Body(count, Snow(800.0, 500.0, 0.025, 0.01, shear_cutoff=1e-3), mass=1.5)


def solvers(count: int, batch: int) -> dict[str, Solver]:
    """Solvers for ``count`` particles, a multiple of 3, by name; ``batch`` is for values that differ in a batch."""
    part = count // 3
    ball = Body(part, Elastic(300.0, 80.0), mass=5.0, volume=1.5)
    sheet = Body(part, VonMises(500.0, 50.0, 60.0), mass=2.0, muscle=True)
    own = VonMises(500.0 * values(batch, seed=1), 50.0 * values(batch, part, seed=2), torch.tensor(60.0).double())
    varied = (
        Body(part, own, mass=2.0 * values(batch, part, seed=3), volume=values(batch, seed=4), muscle=True),
        Body(part, Snow(800.0 * values(batch, seed=5), 500.0, 0.025 * values(1, part, seed=6)), mass=1.5),
        replace(ball, volume=1.5 * values(batch, part, seed=7)),
    )
    free = robot(count, rules=())
    return {
        "von Mises": robot(count),
        "elastic": replace(free, bodies=(Body(count, Elastic(300.0, 80.0), muscle=True),), rules=(FLOOR,)),
        "soil": replace(free, bodies=(soil(count),), rules=(FLOOR,)),
        "three bodies": replace(free, bodies=(sheet, ball, soil(part)), rules=RULES, damping=0.999),
        "tensor values": replace(free, bodies=varied, gravity=10.0 * normal(batch, 2, seed=8), rules=RULES[1:]),
    }


NAMES = tuple(solvers(3, 1))


def lost(count: int, y: float) -> ParticleState:
    """Particles of which the fourth is at this height."""
    state = lively(count)
    x = state.x.clone()
    x[:, 3, 1] = y
    return replace(state, x=x)


def assert_lost_alone(native: ParticleState, eager: ParticleState, start: ParticleState, tolerance: float) -> None:
    """Above and below the window, and at no place, the fourth particle keeps what it has; the others move as ever."""
    others = [k for k in range(start.num_particles) if k != 3]
    torch.testing.assert_close(native.x[:, others], eager.x[:, others], rtol=0, atol=tolerance)
    for result in (native, eager):
        assert torch.equal(result.v[:, 3].cpu(), start.v[:, 3])


def moving(count: int, batch: int) -> tuple[ParticleState, Tensor, Tensor]:
    """State, actuation and window origins; some particles are outside or leave, some inverted, Jp is not one."""
    state = lively(count, batch, strain=0.15)
    x = state.x.clone()
    x[:, ::7, 0] += 0.37  # around the right end of the window
    x[:, 1::11, 1] -= 0.25  # in the ground
    F = state.F.clone()
    F[:, 2::13] = F[:, 2::13].flip(-1)
    state = replace(state, x=x, F=F, Jp=1.0 + 0.05 * normal(batch, count, seed=5))
    origin = torch.tensor([0.03, -0.11], dtype=torch.float64) * normal(batch, 2, seed=6)
    return state, 40.0 * normal(batch, 2, 16, 16, seed=7), origin
