"""Cost of a substep in the scene of RUN: a plastic robot with muscles on the floor, float32, 128x128 nodes."""

import math

import pytest
import torch

import torchmpm
from torchmpm.backends import compiler_found

RULES = (
    torchmpm.VelocityRule("-y", j=(None, 19), friction=math.inf),
    torchmpm.VelocityRule("+y", j=(119, None)),
    torchmpm.VelocityRule("+x", i=(32, 34), j=(61, None)),
    torchmpm.VelocityRule("-x", i=(46, 47), j=(61, None)),
    torchmpm.VelocityRule("+y", i=(33, 46), j=(59, 60)),
)
CENTRE, RADIUS = (0.09, 0.25), 0.09


BACKENDS = [
    "eager",
    pytest.param("compile", marks=pytest.mark.skipif(not compiler_found(), reason="no C++ compiler")),
]


def scene(
    backend: str, batch: int, count: int
) -> tuple[torchmpm.Solver, torchmpm.ParticleState, torch.Tensor, torch.Tensor]:
    """Solver, state, actuation and window origin of RUN; the robot weighs the same for every ``count``."""
    share = 22_000 / count
    robot = torchmpm.Body(
        count, torchmpm.VonMises(mu=650.0, lam=50.0, yield_stress=90.0), mass=2.0 * share, volume=share, muscle=True
    )
    solver = torchmpm.Solver(
        torchmpm.Grid(128), (robot,), gravity=(0.0, -9.0), damping=0.999, rules=RULES, backend=backend
    )
    disc = torchmpm.sampling.disc(torchmpm.sampling.sobol(count, seed=0), CENTRE, RADIUS)
    state = torchmpm.ParticleState.at_rest(torch.as_tensor(disc, dtype=torch.float32).expand(batch, -1, -1))
    wave = 45.0 * torch.sin(torch.arange(128) / 8.0)
    actuation = wave[:, None].expand(batch, 2, 128, 128).contiguous()
    origin = torch.tensor([CENTRE[0] - 0.4, 0.0]).expand(batch, -1)
    return solver, state, actuation, origin


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("batch", "count"), [(1, 22_000), (1, 2_000), (16, 2_000)], ids=["1x22000", "1x2000", "16x2000"]
)
def test_forward(per_substep, backend: str, batch: int, count: int) -> None:
    solver, state, actuation, origin = scene(backend, batch, count)

    def run() -> None:
        with torch.no_grad():
            end = solver.step(state, actuation, substeps=100, origin=origin)
        assert torchmpm.diagnostics.finite(end).all()

    per_substep(run, particles=batch * count, substeps=100, rounds=8)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("batch", "count"), [(1, 2_000)], ids=["1x2000"])
def test_forward_backward(per_substep, backend: str, batch: int, count: int) -> None:
    solver, state, actuation, origin = scene(backend, batch, count)
    actuation.requires_grad_()

    def run() -> None:
        end = solver.step(state, actuation, substeps=100, origin=origin)
        (gradient,) = torch.autograd.grad(end.x[..., 0].mean(), actuation)
        assert gradient.isfinite().all() and gradient.any()

    per_substep(run, particles=batch * count, substeps=100, rounds=5)
