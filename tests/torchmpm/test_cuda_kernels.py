"""The CUDA kernels against the plain substep; without a GPU in Triton's interpreter, which takes its time."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
import torch
from cuda_kernels import DEVICE, cuda, in_use
from native_scenes import NAMES, RULES, moving, solvers
from scenes import assert_close, lively, normal, robot
from test_native_adjoint import (
    STATE,
    Leaves,
    assert_gradients_close,
    corner_leaves,
    gradients,
    state_leaves,
    value_leaves,
    varied,
)
from test_resolved import hard_soil, hardened
from torch import Tensor

from torchmpm import Body, Elastic, Grid, ParticleState, Snow, Solver, VelocityRule, VonMises
from torchmpm.backends import compiler_found

pytestmark = [
    pytest.mark.skipif(not compiler_found(), reason="no C++ compiler"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # of numpy, which computes in the interpreter
    *([pytest.mark.slow] if DEVICE == "cpu" else []),
]

COUNT = 45


@pytest.fixture(autouse=True)
def kernels() -> Iterator[None]:
    """The native backend runs the CUDA kernels."""
    with in_use():
        yield


def both(solver: Solver, *arguments: Tensor | ParticleState | None, **options: object) -> list[ParticleState]:
    """The final states of the native and of the eager backend."""
    arguments = tuple(a if a is None else a.to(DEVICE) for a in arguments)
    options = {k: v.to(DEVICE) if isinstance(v, Tensor) else v for k, v in options.items()}
    return [replace(solver, backend=name).step(*arguments, **options) for name in ("native", "eager")]


def both_gradients(solver: Callable[[Leaves], Solver], given: Leaves, wanted: tuple[str, ...], substeps: int) -> None:
    """Compare the derivatives of the native and of the eager backend."""
    given = {name: value.to(DEVICE) for name, value in given.items()}
    found, expected = (gradients(solver, given, wanted, substeps, name) for name in ("native", "eager"))
    assert all(value.isfinite().all() for value in found.values())
    assert_gradients_close(found, expected, 1e-9)
    assert expected[wanted[0]].abs().max() > 0


def test_kernels_are_those_of_triton(monkeypatch: pytest.MonkeyPatch) -> None:
    """What these tests compare is what they say."""
    launched = []
    launch = cuda.programs.launch
    monkeypatch.setattr(
        cuda.programs, "launch", lambda kernel, *a, **k: launched.append(kernel) or launch(kernel, *a, **k)
    )
    both(robot(6), lively(6), substeps=2)
    assert len(launched) == 1 + 2 * 2 + 1  # rules, two substeps, the arrival


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_equals_eager(name: str, batch: int) -> None:
    """To 1e-10 in double precision: particles leave the window, touch rules, flow, harden."""
    state, field, origin = moving(COUNT, batch)
    assert_close(*both(solvers(COUNT, batch)[name], state, field, substeps=10, origin=origin), 1e-10)


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("name", NAMES)
def test_gradients_in_state_actuation_and_origin(name: str, batch: int) -> None:
    given = state_leaves(COUNT, batch)
    both_gradients(lambda _: solvers(COUNT, batch)[name], given, tuple(given), 5)


@pytest.mark.parametrize("batch", [1, 2])
def test_gradients_in_values(batch: int) -> None:
    """Of every material, in every shape; masses, volumes and gravity too."""
    given = state_leaves(COUNT, batch) | value_leaves(COUNT, batch)
    both_gradients(lambda leaves: varied(COUNT, leaves), given, tuple(value_leaves(3, 1)), 5)


@pytest.mark.parametrize("wanted", ["actuation", "mu", "gravity", "x", "origin"])
def test_gradient_in_one_thing_alone(wanted: str) -> None:
    given = state_leaves(30, 2) | value_leaves(30, 2)
    both_gradients(lambda leaves: varied(30, leaves), given, (wanted,), 1)


@pytest.mark.parametrize("material", [Elastic(300.0, 80.0), VonMises(500.0, 50.0, 60.0), Snow(800.0, 500.0)])
def test_corners_have_the_derivatives_of_the_plain_substep(material: Elastic) -> None:
    solver = robot(12, bodies=(Body(12, material, muscle=True),))
    both_gradients(lambda _: solver, corner_leaves(), STATE, 1)


@pytest.mark.parametrize("substeps", [1, 5])
def test_limited_gradients_of_soil(substeps: int) -> None:
    """Hardened soil and spinning grains, see test_resolved.py."""
    given = hardened(batch=2)
    both_gradients(lambda _: hard_soil(), given, tuple(given), substeps)


@pytest.mark.parametrize("count", [0, 1, 3, 4, len(RULES)])
def test_rules(count: int) -> None:
    """From none to all directions, overlapping, with and without friction, in the world's and the window's frame."""
    given = state_leaves(30, 2)
    both_gradients(lambda _: robot(30, rules=RULES[:count]), given, ("x", "v"), 2)


@pytest.mark.parametrize("name", ["von Mises", "three bodies"])
def test_single_precision(name: str) -> None:
    state, field, origin = moving(COUNT, 2)
    solver = solvers(COUNT, 2)[name]
    exact = replace(solver, backend="eager").step(state, field, substeps=5, origin=origin)
    native, _ = both(solver, state.to(torch.float32), field.float(), substeps=5, origin=origin.float())
    assert native.dtype == torch.float32
    assert_close(native.to("cpu", torch.float64), exact, 1e-4)


@pytest.mark.parametrize("count", [1, 128, 129, 300])
def test_sizes(count: int) -> None:
    """Around the size of a program's block."""
    assert_close(*both(robot(count), lively(count, 2), 40.0 * normal(2, 2, 16, 16, seed=1), substeps=2), 1e-12)


def test_muscles_without_actuation_and_actuation_without_muscles() -> None:
    assert_close(*both(robot(20), lively(20), substeps=2), 1e-12)
    passive = robot(20, bodies=(Body(20, VonMises(500.0, 50.0, 60.0)),))
    assert_close(*both(passive, lively(20), normal(1, 2, 16, 16, seed=1), substeps=2), 1e-12)


def test_window_of_another_size_and_spacing() -> None:
    solver = robot(20, grid=Grid(33, spacing=0.05, margin=0.01), rules=(VelocityRule("-y", j=(None, 10)),))
    state = lively(20, corner=(0.9, 0.4))
    assert_close(*both(solver, state, normal(1, 2, 33, 33, seed=1), substeps=3), 1e-11)


def test_lower_end_of_the_window() -> None:
    """There the weights are extrapolated."""
    assert_close(*both(robot(40, rules=()), lively(40, 2, corner=(0.0, -0.1)), substeps=2), 1e-10)


@pytest.mark.parametrize("y", [math.nan, math.inf, 1e308, 1e30, -1e30, 1e9, -5.0, 5.0])
def test_positions_no_address_exists_for(y: float) -> None:
    """Above and below the window, and at no place, particles keep what they have."""
    state = lively(10)
    x = state.x.clone()
    x[:, 3, 1] = y
    native, eager = both(robot(10, rules=()), replace(state, x=x), substeps=2)
    others = [k for k in range(10) if k != 3]
    torch.testing.assert_close(native.x[:, others], eager.x[:, others], rtol=0, atol=1e-13)
    assert torch.equal(native.v[:, 3].cpu(), state.v[:, 3])


def test_outside_they_keep_everything_and_pass_gradients_through() -> None:
    given = state_leaves(20, 2)
    given["x"] = given["x"] + torch.tensor([5.0, 0.0])
    both_gradients(lambda _: robot(20), given, ("x", "v", "C", "F", "actuation", "origin"), 3)
    state = lively(20, corner=(3.0, 0.4))
    native, _ = both(robot(20), state, substeps=3)
    assert all(torch.equal(getattr(native.to("cpu"), name), getattr(state, name)) for name in STATE)


@pytest.mark.parametrize("name", ["x", "F", "actuation"])
@pytest.mark.parametrize("value", [float("nan"), 1e30])
def test_a_broken_element_harms_no_other(name: str, value: float) -> None:
    given = state_leaves(15, 3)
    given[name][1].view(-1)[::5] = value
    given = {key: t.to(DEVICE).requires_grad_() for key, t in given.items()}
    ends = []
    for chosen in (slice(None), [0, 2]):
        leaves = {key: t[chosen] for key, t in given.items()}
        state = ParticleState(*(leaves[n] for n in STATE))
        solver = replace(solvers(15, 1)["three bodies"], backend="native")
        final = solver.step(state, leaves["actuation"], substeps=3, origin=leaves["origin"])
        final = final[[0, 2]] if chosen == slice(None) else final
        ends.append((final, torch.autograd.grad(final.x.sum() + final.F.square().sum(), list(given.values()))))
    (together, of_all), (apart, of_some) = ends
    assert_close(together, apart, 1e-12)
    for one, other in zip(of_all, of_some, strict=True):
        torch.testing.assert_close(one[[0, 2]], other[[0, 2]], rtol=0, atol=1e-10 * other.abs().max().item())


@pytest.mark.parametrize(("plane", "value"), [(0, math.nan), (1, math.nan), (1, math.inf)])
def test_what_takes_no_part_has_no_derivative_in_shared_constants(plane: int, value: float) -> None:
    """Particles at no place, see test_limits.py; and those outside, whatever else they hold."""
    given = state_leaves(15, 2)
    given["x"][0, 3, plane] = value
    given["x"][0, 4, 0], given["F"][0, 4], given["v"][0, 4] = 9.0, math.nan, math.inf
    given = {name: tensor.to(DEVICE) for name, tensor in given.items()}
    mu = torch.tensor(500.0, dtype=torch.float64, device=DEVICE, requires_grad=True)
    gradients = []
    for backend in ("native", "eager"):
        solver = robot(15, bodies=(Body(15, VonMises(mu, 50.0, 60.0), mass=2.0, muscle=True),), backend=backend)
        state = ParticleState(*(given[name] for name in STATE))
        final = solver.step(state, given["actuation"], substeps=3, origin=given["origin"])
        gradients += torch.autograd.grad(final.F[1].square().sum(), mu)
    assert gradients[1].isfinite() and gradients[1] != 0
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=0)
