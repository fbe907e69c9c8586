"""Cost of a substep in the scene of RUN: a plastic robot with muscles on the floor, float32, 128x128 nodes."""

import math
from dataclasses import replace

import pytest
import torch

import torchmpm
from torchmpm.native.library import find_compiler

RULES = (
    torchmpm.VelocityRule("-y", j=(None, 19), friction=math.inf),
    torchmpm.VelocityRule("+y", j=(119, None)),
    torchmpm.VelocityRule("+x", i=(32, 34), j=(61, None)),
    torchmpm.VelocityRule("-x", i=(46, 47), j=(61, None)),
    torchmpm.VelocityRule("+y", i=(33, 46), j=(59, 60)),
)
CENTRE, RADIUS = (0.09, 0.25), 0.09


SIZES = {"1x22000": (1, 22_000), "1x2000": (1, 2_000), "16x2000": (16, 2_000), "64x2000": (64, 2_000)}
#: Measured on a GPU only.
LARGE = {"1024x2000": (1024, 2_000)}
needs_compiler = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")


def cases(**sizes: str) -> pytest.MarkDecorator:
    """Parameters for the given sizes of each backend; what would take minutes is left out. On a GPU, every size."""
    parameters = [
        pytest.param(name, *SIZES[size], "cpu", id=f"{size}-{name}", marks=() if name == "eager" else needs_compiler)
        for name, listed in sizes.items()
        for size in listed.split()
    ]
    if torch.cuda.is_available():
        parameters += [
            pytest.param(name, *size, "cuda", id=f"{label}-{name}-cuda", marks=needs_compiler)
            for name in ("eager", "native")
            for label, size in (SIZES | LARGE).items()
            if name == "native" or label in sizes["eager"].split()
        ]
    return pytest.mark.parametrize(("backend", "batch", "count", "device"), parameters)


def finish(device: str) -> None:
    """Wait until all is computed."""
    if device == "cuda":
        torch.cuda.synchronize()


def scene(
    backend: str, batch: int, count: int, device: str = "cpu"
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
    return solver, state.to(device), actuation.to(device), origin.to(device)


@cases(eager="1x22000 1x2000 16x2000", native=" ".join(SIZES))
def test_forward(per_substep, backend: str, batch: int, count: int, device: str) -> None:
    solver, state, actuation, origin = scene(backend, batch, count, device)

    def run() -> None:
        with torch.no_grad():
            end = solver.step(state, actuation, substeps=100, origin=origin)
        finish(device)
        assert end.is_finite().all()

    per_substep(run, particles=batch * count, substeps=100, rounds=8)


@needs_compiler
@pytest.mark.parametrize("bodies", ["robot", "robot+ball", "robot+snow", "own-values"])
def test_materials(per_substep, bodies: str) -> None:
    """What other bodies cost natively, next to a robot alone."""
    count = 22_000
    solver, state, actuation, origin = scene("native", 1, count)
    robot, half = solver.bodies[0], count // 2
    gel = robot.material
    per_particle = torchmpm.VonMises(gel.mu * torch.ones(1, count), gel.lam, gel.yield_stress)
    others = {
        "robot": (robot,),
        "robot+ball": (replace(robot, count=half), torchmpm.Body(half, torchmpm.Elastic(gel.mu, gel.lam), 2.0)),
        "robot+snow": (replace(robot, count=half), torchmpm.Body(half, torchmpm.Snow(2083.0, 1389.0), 2.0)),
        "own-values": (replace(robot, material=per_particle),),
    }
    solver = replace(solver, bodies=others[bodies])

    def run() -> None:
        with torch.no_grad():
            end = solver.step(state, actuation, substeps=100, origin=origin)
        assert end.is_finite().all()

    per_substep(run, particles=count, substeps=100, rounds=8)


@cases(eager="1x2000", native=" ".join(SIZES))
def test_forward_backward(per_substep, backend: str, batch: int, count: int, device: str) -> None:
    solver, state, actuation, origin = scene(backend, batch, count, device)
    actuation.requires_grad_()

    def run() -> None:
        end = solver.step(state, actuation, substeps=100, origin=origin)
        (gradient,) = torch.autograd.grad(end.x, actuation, torch.sin(40 * state.x))
        finish(device)
        assert gradient.isfinite().all() and gradient.any()

    per_substep(run, particles=batch * count, substeps=100, rounds=5)
