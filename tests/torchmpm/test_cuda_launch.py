"""Steps through the CUDA kernels against PyTorch: on a GPU, and on an imitation of it under all plans of a launch.

What only the imitation can show is in test_cuda_imitation.py.
"""

import gc
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
import torch
from cuda_drivers import Imitation, in_use
from cuda_imitation import PLANS, Gpu
from native_scenes import NAMES, RULES, assert_lost_alone, lost, moving, solvers
from scenes import Leaves, assert_close, assert_identical, lively, normal, robot
from test_native_adjoint import (
    STATE,
    assert_broken_alone,
    assert_gradients_close,
    compare_gradients,
    corner_leaves,
    gradients,
    state_leaves,
    value_leaves,
    varied,
)
from test_resolved import hard_soil, hardened
from torch import Tensor

from torchmpm import Body, Elastic, Grid, ParticleState, Snow, Solver, VelocityRule, VonMises
from torchmpm.native.library import find_compiler
from torchmpm.solver import kernels_fail

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")
COUNT = 60
ON_A_GPU = pytest.param("cuda", marks=pytest.mark.cuda)
on_a_gpu = pytest.mark.parametrize("device", [ON_A_GPU], indirect=True)
every_plan = pytest.mark.parametrize("device", [*PLANS, "as planned", ON_A_GPU], indirect=True)


@pytest.fixture(params=["as planned", ON_A_GPU], autouse=True)
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    """Where the tensors are; meanwhile the native backend runs the CUDA kernels, as it or as one of the plans says."""
    if request.param == "cuda":
        yield "cuda"
    else:
        with in_use(Gpu(), PLANS[request.param]) if request.param in PLANS else in_use(Imitation()):
            yield "cpu"


def both(solver: Solver, device: str, *arguments: Tensor | ParticleState, **options: object) -> list[ParticleState]:
    """The final states of the native and of the eager backend."""
    arguments = tuple(a.to(device) for a in arguments)
    options = {name: value.to(device) if isinstance(value, Tensor) else value for name, value in options.items()}
    return [replace(solver, backend=name).step(*arguments, **options) for name in ("native", "eager")]


def tolerance(device: str, on_the_cpu: float) -> float:
    """On a GPU, the order of the sums on the nodes and the fused products differ."""
    return max(on_the_cpu, 1e-9) if device == "cuda" else on_the_cpu


def both_gradients(
    solver: Callable[[Leaves], Solver],
    device: str,
    given: Leaves,
    wanted: tuple[str, ...],
    substeps: int,
    on_the_cpu: float = 1e-9,
) -> None:
    """Compare the derivatives of the native and of the eager backend, on a GPU to 1e-8."""
    given = {name: value.to(device) for name, value in given.items()}
    expected = compare_gradients(solver, given, wanted, substeps, 1e-8 if device == "cuda" else on_the_cpu)
    assert expected[wanted[0]].abs().max() > 0


@every_plan
@pytest.mark.parametrize("batch", [1, 5])
@pytest.mark.parametrize("name", NAMES)
def test_equals_eager(name: str, batch: int, device: str) -> None:
    """In double precision: particles leave the window, touch rules, flow, harden."""
    state, field, origin = moving(COUNT, batch)
    ends = both(solvers(COUNT, batch)[name], device, state, field, substeps=8, origin=origin)
    assert_close(*ends, tolerance(device, 1e-12))


@pytest.mark.parametrize("name", ["von Mises", "three bodies"])
def test_single_precision(name: str, device: str) -> None:
    state, field, origin = moving(COUNT, 2)
    solver = solvers(COUNT, 2)[name]
    exact = replace(solver, backend="eager").step(state, field, substeps=5, origin=origin)
    single = both(solver, device, state.to(torch.float32), field.float(), substeps=5, origin=origin.float())[0]
    assert single.dtype == torch.float32
    assert_close(single.to("cpu", torch.float64), exact, 1e-4)


@pytest.mark.parametrize("count", [1, 31, 32, 33, 64, 65, 128, 129, 300])
@pytest.mark.parametrize("batch", [2, 5])
def test_sizes(batch: int, count: int, device: str) -> None:
    """Around those of a block, of a team of blocks and of the registers, with few robots and with many."""
    state, field, origin = moving(count, batch)
    ends = both(robot(count), device, state, field, substeps=5, origin=origin)
    assert_close(*ends, tolerance(device, 1e-12))


@pytest.mark.parametrize("count", [0, 1, 3, len(RULES)])
def test_rules(count: int, device: str) -> None:
    """From none to all directions, overlapping, with and without friction, in the world's and the window's frame."""
    both_gradients(lambda _: robot(30, rules=RULES[:count]), device, state_leaves(30, 2), ("x", "v"), 2)


@every_plan
@pytest.mark.parametrize("name", NAMES)
def test_gradients_in_state_actuation_and_origin(name: str, device: str) -> None:
    given = state_leaves(COUNT, 3)
    both_gradients(lambda _: solvers(COUNT, 3)[name], device, given, tuple(given), 6, 1e-10)


@every_plan
@pytest.mark.parametrize("batch", [1, 2])
def test_gradients_in_values(batch: int, device: str) -> None:
    """Of every material, in every shape; masses, volumes and gravity too."""
    given = state_leaves(COUNT, batch) | value_leaves(COUNT, batch)
    both_gradients(lambda leaves: varied(COUNT, leaves), device, given, tuple(value_leaves(3, 1)), 5)


@pytest.mark.parametrize("wanted", ["actuation", "mu", "gravity", "x", "origin"])
def test_gradient_in_one_thing_alone(wanted: str, device: str) -> None:
    given = state_leaves(30, 2) | value_leaves(30, 2)
    both_gradients(lambda leaves: varied(30, leaves), device, given, (wanted,), 1)


@pytest.mark.parametrize("material", [Elastic(300.0, 80.0), VonMises(500.0, 50.0, 60.0), Snow(800.0, 500.0)])
def test_corners_have_the_derivatives_of_the_plain_substep(material: Elastic, device: str) -> None:
    solver = robot(12, bodies=(Body(12, material, muscle=True),))
    both_gradients(lambda _: solver, device, corner_leaves(), STATE, 1)


def test_limited_gradients_of_soil(device: str) -> None:
    """Hardened soil and spinning grains, see test_resolved.py."""
    given = hardened(batch=2)
    both_gradients(lambda _: hard_soil(), device, given, tuple(given), 3)


def test_gradients_of_soil_in_single_precision_are_finite(device: str) -> None:
    """Strains whose squares are smaller than the smallest normal number have derivatives like others."""
    leaves = {name: value.float().to(device) for name, value in state_leaves(30, 1).items()}
    small = torch.eye(2) + 1e-20 * normal(1, 30, 2, 2, seed=3).float()
    leaves["F"] = small.to(device)
    solver = replace(solvers(30, 1)["soil"], backend="native")
    found = gradients(lambda _: solver, leaves, ("x", "v", "F"), 3, "native")
    assert all(value.isfinite().all() for value in found.values())


@pytest.mark.parametrize("count", [20, 60])
def test_muscles_without_actuation_and_actuation_without_muscles(count: int, device: str) -> None:
    """In a block of its own, and shared by blocks."""
    exact = tolerance(device, 1e-12)
    assert_close(*both(robot(count), device, lively(count), substeps=4), exact)
    passive = robot(count, bodies=(Body(count, VonMises(500.0, 50.0, 60.0)),))
    assert_close(*both(passive, device, lively(count), normal(1, 2, 16, 16, seed=1), substeps=2), exact)
    given = state_leaves(count, 1)
    both_gradients(lambda _: passive, device, given, ("x",), 3, 1e-10)
    zero = gradients(lambda _: passive, {k: v.to(device) for k, v in given.items()}, ("actuation",), 2, "native")
    assert not zero["actuation"].any()


def test_window_of_another_size_and_spacing(device: str) -> None:
    solver = robot(20, grid=Grid(33, spacing=0.05, margin=0.01), rules=(VelocityRule("-y", j=(None, 10)),))
    state = lively(20, corner=(0.9, 0.4))
    assert_close(*both(solver, device, state, normal(1, 2, 33, 33, seed=1), substeps=3), 1e-9)


@pytest.mark.parametrize("count", [10, 60])
@pytest.mark.parametrize("y", [math.nan, math.inf, 1e308, 1e30, -1e30, 1e9, -5.0, 5.0])
def test_positions_no_address_exists_for(y: float, count: int, device: str) -> None:
    start, exact = lost(count, y), 1e-10 if device == "cuda" else 1e-13
    assert_lost_alone(*both(robot(count, rules=()), device, start, substeps=2), start, exact)


@pytest.mark.parametrize("name", ["x", "v", "F", "actuation"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
@pytest.mark.parametrize(("dtype", "exact"), [(torch.float32, 1e-5), (torch.float64, 1e-9)])
def test_a_broken_robot_harms_no_other(name: str, value: float, dtype: torch.dtype, exact: float, device: str) -> None:
    given = state_leaves(15, 3)
    given[name][1].view(-1)[::5] = value
    solver = replace(solvers(15, 1)["three bodies"], backend="native")
    assert_broken_alone(solver, {key: t.to(device, dtype) for key, t in given.items()}, exact)


@pytest.mark.parametrize("count", [30, 60])
def test_results_are_the_same_in_every_run_and_of_small_robots_in_every_batch(count: int, device: str) -> None:
    """Bit for bit: sums of integers do not depend on their order. Large robots alone are shared by blocks."""
    state, field, origin = (t.to(device) for t in moving(count, 5))
    solver = replace(solvers(count, 1)["three bodies"], backend="native")
    first, again = (solver.step(state, field, substeps=5, origin=origin) for _ in range(2))
    assert_identical(first, again)
    alone = solver.step(state[[3]], field[[3]], substeps=5, origin=origin[[3]])
    assert_close(alone, first[[3]], 0.0 if count == 30 else 1e-9)


def test_long_steps_are_cut(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At checkpoints; derivatives go through them."""
    given = {name: value.to(device) for name, value in state_leaves(15, 2).items()}
    solver = solvers(15, 2)["three bodies"]
    monkeypatch.setattr("torchmpm.native.kernels.Kernels.tape_limit", lambda *_: 3)
    found = gradients(lambda _: solver, given, ("x", "actuation"), 7, "native")
    assert_gradients_close(found, gradients(lambda _: solver, given, ("x", "actuation"), 7, "eager"), 1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_check_of_a_device_passes(dtype: torch.dtype, device: str) -> None:
    kernels_fail.cache_clear()
    assert kernels_fail(torch.device(device, 0) if device == "cuda" else torch.device(device), dtype) is None
    kernels_fail.cache_clear()


@on_a_gpu
def test_auto_is_native_on_a_gpu(device: str) -> None:
    solver, state = robot(30, backend="auto"), lively(30).to("cuda")
    assert solver.runs_native(state)
    assert_identical(solver.step(state, substeps=3), replace(solver, backend="native").step(state, substeps=3))


@on_a_gpu
def test_on_another_stream(device: str) -> None:
    """It waits for what that stream computes, and for nothing else."""
    solver, state = robot(300, backend="native"), lively(300, 4).to("cuda")
    expected, stream = solver.step(state, substeps=50), torch.cuda.Stream()
    with torch.cuda.stream(stream):
        late = torch.zeros_like(state.x)
        torch.cuda._sleep(10**8)
        late += state.x
        found = solver.step(replace(state, x=late), substeps=50)
    stream.synchronize()
    assert_identical(found, expected)


@on_a_gpu
def test_within_a_graph_of_the_caller(device: str) -> None:
    """A step waits for nothing and copies nothing, so that a CUDA graph can hold it."""
    solver, state = robot(100, backend="native"), lively(100).to("cuda")
    with torch.no_grad():
        expected = solver.step(state, substeps=5)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            found = solver.step(state, substeps=5)
    graph.replay()
    assert_identical(found, expected)


@on_a_gpu
def test_memory_is_given_back(device: str) -> None:
    solver, state = robot(300, backend="native"), lively(300, 4).to("cuda")
    x = state.x.clone().requires_grad_()
    for _ in range(2):
        gc.collect()
        before = torch.cuda.memory_allocated()
        torch.autograd.grad(solver.step(replace(state, x=x), substeps=20).x.sum(), x)
    assert torch.cuda.memory_allocated() == before
