"""The scene of `test_solver.py` in Taichi and in every backend, side by side: are they equal, and how much faster."""

import numpy as np
import pytest
import torch

import torchmpm
from torchmpm.native.library import find_compiler

ti = pytest.importorskip("taichi")

from taichi_mpm import PAD, TaichiRobot  # noqa: E402
from test_solver import SIZES, scene  # noqa: E402

pytestmark = pytest.mark.filterwarnings("default::DeprecationWarning")
SUBSTEPS = 100
#: Particles in random order, and particles sorted by x with longer blocks for each thread.
PEERS = ("taichi", "taichi-ordered")


@pytest.fixture(scope="module")
def minima(request: pytest.FixtureRequest):
    """Milliseconds of each case; at the end they are printed relative to Taichi."""
    least: dict[tuple[str, str, str], float] = {}
    yield least
    capture = request.config.pluginmanager.get_plugin("capturemanager")
    report = request.config.pluginmanager.get_plugin("terminalreporter")
    with capture.global_and_fixture_disabled():
        report.section(f"times as fast as {' and '.join(PEERS)} (minima)")
        for (kind, size, backend), value in least.items():
            others = [least[kind, size, peer] for peer in PEERS if (kind, size, peer) in least]
            ratios = "".join(f"{other / value:10.2f}" for other in others)
            report.line(f"{kind + '-' + size + '-' + backend:40}{ratios}")


def order(state: torchmpm.ParticleState) -> torch.Tensor:
    """(B, N) particles from left to right."""
    return state.x[..., 0].argsort(dim=1)


def peer(name: str, batch: int, count: int, history: int) -> TaichiRobot:
    """The scene in Taichi, on as many threads as torch has: as it is drawn, or ordered."""
    ti.init(ti.cpu, cpu_max_num_threads=torch.get_num_threads(), log_level=ti.ERROR)
    solver, state, actuation, origin = scene("eager", batch, count)
    x, block = state.x, 128
    if name == "taichi-ordered":
        x = x.gather(1, order(state)[..., None].expand(-1, -1, 2))
        block = 8192 if batch * count > 8192 else 1024  # the fastest of 128 ... 16384
    robot = TaichiRobot(solver, batch, history, float(origin[0, 0]), block)
    robot.start(x.numpy(), actuation.numpy())
    return robot


def cases(**sizes: str) -> pytest.MarkDecorator:
    """Size by size, so that what is compared runs within the same minute."""
    needs_compiler = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
    return pytest.mark.parametrize(
        ("backend", "size"),
        [
            pytest.param(name, size, id=f"{size}-{name}", marks=needs_compiler if name == "native" else ())
            for size in SIZES
            for name, listed in sizes.items()
            if size in listed.split()
        ],
    )


@pytest.mark.parametrize("name", PEERS)
def test_same_motion(name: str) -> None:
    """Taichi and torchmpm agree after a step: positions and the gradient in the actuation."""
    robot = peer(name, 2, 2_000, SUBSTEPS)
    robot.run(SUBSTEPS)
    solver, state, actuation, origin = scene("auto", 2, 2_000)
    end = solver.step(state, actuation.requires_grad_(), substeps=SUBSTEPS, origin=origin).x
    places = order(state) if name == "taichi-ordered" else torch.arange(2_000).expand(2, -1)
    places = places[..., None].expand(-1, -1, 2)
    np.testing.assert_allclose(robot.positions(), end.detach().gather(1, places).numpy(), rtol=0, atol=1e-4)
    assert (end - state.x).abs().max() > 1e-3

    cotangent = torch.sin(40 * state.x)
    (expected,) = torch.autograd.grad(end, actuation, cotangent)
    nodes = slice(PAD, -PAD)
    gradient = robot.gradient(cotangent.gather(1, places).numpy()).to_numpy()[:, nodes, nodes].transpose(0, 3, 1, 2)
    np.testing.assert_allclose(gradient, expected.numpy(), rtol=0, atol=1e-3 * float(expected.abs().max()))


EVERY = " ".join(SIZES)


@cases(**dict.fromkeys(PEERS, EVERY), native=EVERY, eager="1x22000 1x2000 16x2000")
def test_forward(per_substep, benchmark, minima, backend: str, size: str) -> None:
    batch, count = SIZES[size]
    if backend in PEERS:
        robot = peer(backend, batch, count, 0)

        def run() -> None:
            robot.run(SUBSTEPS)
    else:
        solver, state, actuation, origin = scene(backend, batch, count)

        def run() -> None:
            with torch.no_grad():
                end = solver.step(state, actuation, substeps=SUBSTEPS, origin=origin)
            assert end.is_finite().all()

    per_substep(run, particles=batch * count, substeps=SUBSTEPS, rounds=8)
    if benchmark.stats is not None:
        minima["forward", size, backend] = benchmark.stats["min"]


@cases(**dict.fromkeys(PEERS, EVERY), native=EVERY, eager="1x2000")
def test_forward_backward(per_substep, benchmark, minima, backend: str, size: str) -> None:
    batch, count = SIZES[size]
    if backend in PEERS:
        robot = peer(backend, batch, count, SUBSTEPS)
        cotangent = np.sin(40 * robot.x.to_numpy()[0]) / (batch * count)

        def run() -> None:
            robot.run(SUBSTEPS)
            robot.gradient(cotangent)
    else:
        solver, state, actuation, origin = scene(backend, batch, count)
        actuation.requires_grad_()

        def run() -> None:
            end = solver.step(state, actuation, substeps=SUBSTEPS, origin=origin)
            (gradient,) = torch.autograd.grad(end.x, actuation, torch.sin(40 * state.x) / (batch * count))
            assert gradient.isfinite().all() and gradient.any()

    per_substep(run, particles=batch * count, substeps=SUBSTEPS, rounds=5)
    if benchmark.stats is not None:
        minima["forward_backward", size, backend] = benchmark.stats["min"]
