"""The native kernels against the plain substep, in every material and batch."""

import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from native_scenes import NAMES, assert_lost_alone, lost, moving, solvers
from scenes import assert_as_precise, assert_close, assert_identical, lively, normal, robot

from torchmpm import Body, Grid, ParticleState, Snow, Solver, VelocityRule, VonMises
from torchmpm.grid import PAD
from torchmpm.native import kernels
from torchmpm.native.kernels import MAX_PARTICLES, MAX_RESOLUTION
from torchmpm.native.library import find_compiler

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")

COUNT = 300


def both(solver: Solver, *arguments: object, **options: object) -> tuple[ParticleState, ParticleState]:
    """The final states of the native and of the eager backend."""
    native, eager = (replace(solver, backend=name).step(*arguments, **options) for name in ("native", "eager"))
    return native, eager


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("name", NAMES)
def test_equals_eager(name: str, batch: int) -> None:
    """To 1e-10 over 100 substeps in double precision: particles leave the window, touch rules, flow, harden."""
    state, field, origin = moving(COUNT, batch)
    native, eager = both(solvers(COUNT, batch)[name], state, field, substeps=100, origin=origin)
    assert_close(native, eager, 1e-10)
    assert (eager.x - state.x).abs().max() > 0.003


@pytest.mark.parametrize("name", NAMES)
def test_single_precision(name: str) -> None:
    state, field, origin = moving(COUNT, 2)
    solver = solvers(COUNT, 2)[name]
    exact = replace(solver, backend="eager").step(state, field, substeps=20, origin=origin)
    native, eager = both(solver, state.to(torch.float32), field.float(), substeps=20, origin=origin.float())
    assert native.dtype == torch.float32
    assert_as_precise(native, eager, exact)


@pytest.mark.parametrize(("batch", "count"), [(1, 1), (2, 1), (1, 63), (1, 64), (3, 65), (1, 2500), (2, 9000)])
def test_sizes(batch: int, count: int) -> None:
    """Around the sizes of blocks and of groups of blocks."""
    state = lively(count, batch)
    native, eager = both(robot(count), state, 40.0 * normal(batch, 2, 16, 16, seed=1), substeps=3)
    assert_close(native, eager, 1e-12)


def test_state_in_other_strides() -> None:
    """Fields as users build them, not as planes."""
    state, field, origin = moving(60, 2)
    state = ParticleState(
        *(getattr(state, name).transpose(0, 1).contiguous().transpose(0, 1) for name in "xvCF"), state.Jp
    )
    transposed = field.transpose(2, 3).contiguous().transpose(2, 3)
    assert_close(*both(robot(60), state, transposed, substeps=5, origin=origin.T.contiguous().T), 1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_constant_is_the_same_in_every_form(dtype: torch.dtype) -> None:
    """Bit by bit: as a number, and beside the constants of others as one for each simulation or particle."""
    state = lively(24, 3).to(dtype)
    others = torch.tensor([1.3, 1.0, 0.4], dtype=dtype)

    def solver(form: Callable[[float], float | torch.Tensor], yield_stress: float) -> Solver:
        gel = VonMises(form(640.0), form(75.0), form(yield_stress))
        bodies = (Body(12, gel, form(2.0), form(1.5)), Body(12, Snow(form(800.0), form(500.0), form(0.25)), form(1.5)))
        return robot(24, bodies=bodies, backend="native")

    for yield_stress in (0.5, 64.0, 128.0):  # limits of 4e-4, where digits are lost, to 0.1
        alone = solver(float, yield_stress).step(state, substeps=20)
        together = solver(lambda value: value * others, yield_stress).step(state, substeps=20)
        each = solver(lambda value: value * others[:, None].expand(3, 12), yield_stress).step(state, substeps=20)
        assert_identical(together[1], alone[1])
        assert_identical(each, together)
        assert not torch.equal(together.F[0], alone.F[0])


@pytest.mark.parametrize("y", [math.nan, math.inf, -math.inf, 1e308, 1e30, -1e30, 1e9, -5.0, 5.0])
def test_positions_no_address_exists_for(y: float) -> None:
    assert_lost_alone(*both(robot(20, rules=()), lost(20, y), substeps=3), lost(20, y), 1e-13)


def test_what_the_kernels_do_not_support_is_named() -> None:
    """Eight numbers of each node of a simulation, and its particles, must have places below 2^31."""
    assert 8 * (MAX_RESOLUTION + 2 * PAD) ** 2 < 2**31
    cases = {
        "300": robot(10, rules=(VelocityRule("-y"),) * 300),
        "16,001": robot(10, grid=Grid(MAX_RESOLUTION + 1), dt=1e-9),
        "1,073,741,825": robot(MAX_PARTICLES + 1),
    }
    for named, solver in cases.items():
        assert named in str(solver.kernels.unsupported(torch.device("cpu")))
    largest = robot(MAX_PARTICLES, grid=Grid(MAX_RESOLUTION), dt=1e-9)
    assert largest.kernels.unsupported(torch.device("cpu")) is None


@pytest.mark.slow
def test_addresses_of_a_large_batch() -> None:
    """More than 2^31 numbers in a tensor: the last simulation feels its own field. Zeros not written take no room."""
    batch, nodes = 66_000, 128
    field = torch.from_numpy(np.zeros((batch, 2, nodes, nodes), np.float32))
    field[-1] = 30.0 * torch.sin(torch.arange(nodes) / 3.0)
    assert field[-1, 0, 0, 0].data_ptr() - field.data_ptr() > 4 * 2**31
    solver = robot(2, grid=Grid(nodes), rules=(), gravity=(0.0, 0.0), backend="native")
    state = ParticleState.at_rest(torch.tensor([[0.5, 0.5], [0.505, 0.502]]).expand(batch, 2, 2))
    result = solver.step(state, field, substeps=5)
    assert_identical(result[-1], solver.step(state[-1], field[-1:], substeps=5))
    assert (result.v[-1] != 0).any() and (result.v[:-1] == 0).all()


def test_grains_pulled_apart_for_ever() -> None:
    """Jp reaches its limit in some particles within a substep; values and derivatives agree on both sides of it."""
    solver, state = solvers(30, 1)["soil"], lively(30, 1, strain=0.0)
    Jp = torch.linspace(0.2, 0.9999, 30, dtype=torch.float64)[None] * 1e30
    results = []
    for backend in ("native", "eager"):
        F = (2.0 * state.F).requires_grad_()
        final = replace(solver, backend=backend).step(replace(state, F=F, Jp=Jp))
        results.append((final.detach(), torch.autograd.grad((final.Jp / 1e30).sum(), F)[0]))
    (native, slope), (eager, expected) = results
    assert eager.Jp.max() == 1e30 and (expected != 0).any() and (expected == 0).all(-1).all(-1).any()
    torch.testing.assert_close(native.Jp, eager.Jp, rtol=1e-13, atol=0)
    torch.testing.assert_close(slope, expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_soil_that_was_pulled_apart_is_as_soft_as_in_the_eager_backend(dtype: torch.dtype) -> None:
    """The exponential of large negative numbers is 0, not infinite."""
    solver = Solver(Grid(32), (Body(5, Snow(2000.0, 1000.0), mass=2.0),))
    rest = ParticleState.at_rest(torch.full((1, 5, 2), 0.5, dtype=dtype))
    Jp = torch.tensor([[1.0, 20.0, 3e4, 1e22, 1e29]], dtype=dtype)
    native, eager = both(solver, replace(rest, F=0.99 * rest.F, Jp=Jp))
    assert_close(native, eager, 1e-4 if dtype == torch.float32 else 1e-12)


@pytest.mark.parametrize("backend", ["native", "eager"])
def test_soil_without_hardening_has_no_derivative_in_jp(backend: str) -> None:
    solver = Solver(Grid(32), (Body(1, Snow(2000.0, 1000.0, hardening_range=(1.0, 1.0)), mass=2.0),), backend=backend)
    rest = ParticleState.at_rest(torch.full((1, 1, 2), 0.5, dtype=torch.float64))
    Jp = torch.ones(1, 1, dtype=torch.float64, requires_grad=True)
    later = solver.step(replace(rest, F=0.99 * rest.F, Jp=Jp), substeps=2)
    assert later.C.abs().max() > 0 and torch.autograd.grad(later.C.sum(), Jp)[0].item() == 0


ENDLESS = """
import signal, torch, torchmpm
drop = torchmpm.Body(500, torchmpm.Elastic(*torchmpm.lame(4e4, 0.3)), mass=0.016, volume=1.6e-5)
solver = torchmpm.Solver(torchmpm.Grid(128), (drop,), backend="native")
state = torchmpm.ParticleState.at_rest(0.4 + 0.2 * torch.rand(4, 500, 2))
solver.step(state)
signal.signal(signal.SIGALRM, signal.default_int_handler)
for enabled in (True, False):
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        with torch.set_grad_enabled(enabled):
            solver.step(state, substeps=10**12)
    except KeyboardInterrupt:
        print("stopped")
"""


def test_a_long_step_can_be_stopped() -> None:
    done = subprocess.run([sys.executable, "-c", ENDLESS], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == 2 * "stopped\n"


@pytest.mark.parametrize("counts", [(640,), (1,) * 100, (65,) * 100])
def test_gradients_of_long_steps_take_little_memory(counts: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """A tape has room for blocks of particles, which are those of one body."""
    monkeypatch.setattr(kernels, "_free_scratch", [])
    solver = Solver(Grid(16), tuple(Body(count, VonMises(500.0, 50.0, 62.0), 1.0, 1e-3) for count in counts))
    start = ParticleState.at_rest(normal(1, sum(counts), 2, seed=0).float() * 0.05 + 0.5)
    start = replace(start, v=start.v.clone().requires_grad_())
    solver.step(start, substeps=1500).x.sum().backward()
    (buffer,) = kernels._free_scratch
    assert buffer.nbytes < 1.1 * kernels.TAPE_BYTES
