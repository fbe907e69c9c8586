"""The CUDA kernels on the CPU, as in ``imitation/cuda_imitation.hpp``: threads are fibres that run in random order."""

import faulthandler
import math
import os
import re
import signal
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace

import pytest
import torch
from cuda_drivers import in_use
from cuda_imitation import PLANS, Broken, Gpu, Plan, Threads
from native_scenes import NAMES, moving, solvers
from scenes import assert_as_precise, assert_close, assert_identical, lively, normal, robot
from test_native_adjoint import assert_gradients_close, compare_gradients, gradients, state_leaves
from torch import Tensor

from torchmpm import Grid, ParticleState, Solver
from torchmpm.native.cuda.compiler import FOLDERS
from torchmpm.native.library import find_compiler

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")

COUNT = 60
every_plan = pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)


def step(solver: Solver, backend: str, *arguments: object, **options: object) -> ParticleState:
    return replace(solver, backend=backend).step(*arguments, **options)


@every_plan
@pytest.mark.parametrize("name", NAMES)
def test_single_precision(name: str, plan: Plan) -> None:
    state, field, origin = moving(COUNT, 2)
    solver = solvers(COUNT, 2)[name]
    exact = step(solver, "eager", state, field, substeps=20, origin=origin)
    single = state.to(torch.float32), field.float()
    with in_use(Gpu(), plan):
        native, plain = (step(solver, b, *single, substeps=20, origin=origin.float()) for b in ("native", "eager"))
    assert_as_precise(native, plain, exact)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@every_plan
def test_order_of_threads_makes_no_difference(plan: Plan, dtype: torch.dtype) -> None:
    """Bit by bit, whatever order threads and blocks run in."""
    state, field, origin = moving(COUNT, 3)
    solver = solvers(COUNT, 3)["three bodies"]
    ends = []
    for seed in range(4):
        with in_use(Gpu(seed), plan):
            ends.append(step(solver, "native", state.to(dtype), field.to(dtype), substeps=6, origin=origin.to(dtype)))
    for end in ends[1:]:
        assert_identical(end, ends[0])


@every_plan
@pytest.mark.parametrize("name", NAMES)
def test_gradients_in_single_precision(name: str, plan: Plan) -> None:
    given = state_leaves(COUNT, 2)
    double = gradients(lambda _: solvers(COUNT, 2)[name], given, tuple(given), 8, "eager")
    single = {key: value.float() for key, value in given.items()}
    with in_use(Gpu(), plan):
        found = gradients(lambda _: solvers(COUNT, 2)[name], single, tuple(given), 8, "native")
    assert all(value.isfinite().all() for value in found.values())
    assert_gradients_close({n: v.double() for n, v in found.items()}, double, 5e-3)


def test_a_window_follows_fast_robots() -> None:
    """Through a grid of four times its size, with muscles and rules of the world; none of them is given up."""
    solver = robot(COUNT, grid=Grid(40), gravity=(0.0, 0.0))
    still = lively(COUNT, 3, corner=(0.2, 0.3))
    state = replace(still, x=0.4 * still.x, v=torch.tensor([250.0, 180.0]) + 0.0 * still.v, C=0.0 * still.C)
    field = 40.0 * normal(3, 2, 40, 40, seed=1)
    leaves = {"x": state.x, "v": state.v, "C": state.C, "F": state.F, "Jp": state.Jp, "actuation": field}
    leaves["origin"] = torch.zeros(3, 2, dtype=torch.float64)
    with in_use(Gpu(), Plan(window=(14, 12))):
        native, eager = (step(solver, b, state, field, substeps=25) for b in ("native", "eager"))
        compare_gradients(lambda _: solver, leaves, ("F", "actuation", "origin"), 25, 1e-9)
    assert (native.x - state.x).abs().amin() * 40 > 10, "a robot must cross nearly as many nodes as the window has"
    assert_close(native, eager, 1e-11)


@pytest.mark.parametrize("corner", [(0.0, -0.1), (0.75, 0.8), (-0.2, 0.4)])
def test_ends_of_the_window(corner: tuple[float, float]) -> None:
    """Where weights are extrapolated, nodes do not exist, and particles are outside."""
    given = state_leaves(COUNT, 2) | {"x": lively(COUNT, 2, corner=corner).x}
    for plan in (Plan(), Plan(window=(12, 12)), Plan(shared=False, team=2)):
        with in_use(Gpu(), plan):
            compare_gradients(lambda _: robot(COUNT, rules=()), given, tuple(given), 4, 1e-9)


def test_not_a_number_spreads_as_on_the_cpu() -> None:
    """To the particles around it, and not as zero or as a number that looks right."""
    state = lively(COUNT, 2)
    F = state.F.clone()
    F[1, 7] = math.nan
    plain = step(robot(COUNT), "eager", replace(state, F=F), substeps=2)
    for plan in (Plan(team=2, muscles=False), Plan(shared=False, team=1, muscles=False)):
        with in_use(Gpu(), plan):
            native = step(robot(COUNT), "native", replace(state, F=F), substeps=2)
        assert torch.equal(native.v.isfinite(), plain.v.isfinite())
        torch.testing.assert_close(native.v, plain.v, rtol=0, atol=1e-11, equal_nan=True)
    assert 0 < plain.v[1].isnan().sum() < 2 * COUNT


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_robots_that_leave_the_range_of_the_sums_are_taken_again(dtype: torch.dtype) -> None:
    """Muscles of a strong field that a robot enters make it faster than shared memory has room for."""
    still = lively(COUNT, 2, strain=0.0)
    state = replace(still, v=torch.tensor([200.0, 0.0]) + 0.0 * still.v, C=0.0 * still.C).to(dtype)
    field = torch.zeros(2, 2, 16, 16, dtype=dtype)
    field[1, :, 12:] = 1e7
    solver = robot(COUNT, rules=(), gravity=(0.0, 0.0))
    eager = step(solver, "eager", state, field, substeps=6)
    ends = []
    for plan in (Plan(), Plan(team=2)):
        with in_use(Gpu(), plan):
            ends.append(step(solver, "native", state, field, substeps=6))
    assert ends[0].v[0].isfinite().all() and ends[0].v[1].isnan().all(), "the second must have been given up"
    assert_close(ends[1], eager, 1e-10 if dtype == torch.float64 else 1e-4)


# What a test can take away from the kernels.
BARRIERS, ATOMICS = (
    re.findall(r"^    ([A-Z_]+)[,\n]", enum, re.MULTILINE)[:-1]
    for enum in re.findall(r"^enum [^{]*{(.*?)^};", (FOLDERS[0] / "machine.cuh").read_text(), re.DOTALL | re.MULTILINE)
)
Ends = list[list[Tensor]]
#: Robots whose blocks pass every barrier and use every atomic operation: a window that must move, a team of blocks,
#: robots that are given up.
SCENES = (Plan(window=(14, 12), teams=1), Plan(shared=False, team=2, teams=1), Plan(window=(6, 6), teams=1, team=1))


def outcomes(gpu: Gpu) -> Iterator[list[Tensor]]:
    """States and derivatives in all scenes; an empty list where a launch did not end well."""
    solver = robot(40, grid=Grid(24), rules=robot(1).rules)
    given = {key: value for key, value in state_leaves(40, 2).items() if key not in ("actuation", "origin")}
    given["x"], given["v"] = 0.8 * lively(40, 2).x, given["v"] + torch.tensor([250.0, -150.0])
    given["actuation"], given["origin"] = 40.0 * normal(2, 2, 24, 24, seed=1), torch.zeros(2, 2).double()
    for plan in SCENES:
        leaves = {key: value.clone().requires_grad_() for key, value in given.items()}
        state = ParticleState(*(leaves[name] for name in ("x", "v", "C", "F", "Jp")))
        try:
            with in_use(gpu, plan):
                end = step(solver, "native", state, leaves["actuation"], substeps=8, origin=leaves["origin"])
                found = [end.stack().detach(), *torch.autograd.grad(end.stack().square().sum(), tuple(leaves.values()))]
        except Broken:
            found = []
        yield found


def same(first: list[Tensor], second: list[Tensor]) -> bool:
    """Whether states are the same bit for bit, and derivatives but for rounding."""
    if not first or not second or not torch.equal(first[0], second[0]):
        return False
    return all((a - b).abs().max() <= 1e-9 * b.abs().max() for a, b in zip(first[1:], second[1:], strict=True))


@pytest.fixture(scope="module")
def intact() -> Ends:
    return list(outcomes(Gpu()))


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_missing(seed: int, intact: Ends) -> None:
    assert all(map(same, outcomes(Gpu(seed)), intact))


def noticed(gpu: Gpu, intact: Ends) -> bool:
    """Whether numbers differ, or the kernels fail; in a process of its own, as they may write anywhere."""
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        faulthandler.disable()
        with suppress(BaseException):
            os._exit(int(not all(same(*pair) for pair in zip(outcomes(gpu), intact, strict=True))))
        os._exit(1)
    return os.waitpid(child, 0)[1] != 0


@pytest.mark.parametrize("name", BARRIERS)
def test_every_barrier_is_needed(name: str, intact: Ends) -> None:
    """Without it, some order of threads gives other numbers, or threads wait for ever."""
    index = BARRIERS.index(name)
    assert any(noticed(Gpu(seed, missing_barrier=index), intact) for seed in range(5))


@pytest.mark.parametrize("name", ATOMICS)
def test_every_atomic_operation_is_needed(name: str, intact: Ends) -> None:
    """As a load and a store, between which other threads run, it loses what they add."""
    index = ATOMICS.index(name)
    assert any(noticed(Gpu(seed, plain_atomic=index), intact) for seed in range(5))


def test_nothing_is_noticed_where_nothing_is_missing(intact: Ends) -> None:
    assert not noticed(Gpu(seed=9), intact)


@pytest.mark.parametrize("plan", [Plan(window=(14, 14)), Plan(shared=False, team=2, teams=1)], ids=["shared", "team"])
def test_thread_sanitizer_finds_no_race(plan: Plan) -> None:
    """With real threads: two bodies, muscles, rules, robots that are given up or leave the window; both kernels."""
    given = {key: value.float() for key, value in state_leaves(30, 2).items()}
    with in_use(Threads(), replace(plan, sizes=(8, 4))):
        gradients(lambda _: solvers(30, 2)["three bodies"], given, ("x", "actuation"), 3, "native")
