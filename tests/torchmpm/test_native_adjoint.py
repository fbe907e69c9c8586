"""The hand-derived adjoint against automatic differentiation of the plain substep."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from native_scenes import NAMES, RULES, moving, solvers, values
from scenes import Leaves, assert_identical, combination, lively, normal, robot
from torch import Tensor

from torchmpm import Body, Elastic, Grid, ParticleState, Snow, Solver, VelocityRule, VonMises
from torchmpm.native import kernels
from torchmpm.native.library import find_compiler

pytestmark = pytest.mark.skipif(not find_compiler(), reason="no C++ compiler")

COUNT = 120
STATE = ("x", "v", "C", "F", "Jp")


def state_leaves(count: int, batch: int) -> Leaves:
    """State, actuation and origin of :func:`native_scenes.moving`."""
    state, field, origin = moving(count, batch)
    return {name: getattr(state, name) for name in STATE} | {"actuation": field, "origin": origin}


def value_leaves(count: int, batch: int) -> Leaves:
    """Every material value in one of the shapes that are accepted."""
    part = count // 3
    return {
        "mu": 500.0 * values(batch, seed=1),
        "lam": 50.0 * values(batch, part, seed=2),
        "yield_stress": torch.tensor(60.0, dtype=torch.float64),
        "mass": 2.0 * values(batch, part, seed=3),
        "volume": values(batch, seed=4),
        "soil_mu": 800.0 * values(batch, part, seed=5),
        "soil_lam": torch.tensor(500.0, dtype=torch.float64),
        "compression": 0.025 * values(batch, seed=6),
        "stretch": 0.01 * values(1, part, seed=7),
        "hardening": 10.0 * values(batch, seed=8),
        "soil_mass": 1.5 * values(batch, seed=9),
        "ball_mu": torch.tensor(300.0, dtype=torch.float64),
        "ball_volume": 1.5 * values(batch, 1, seed=10),
        "gravity": 9.0 * normal(batch, 2, seed=11),
    }


def varied(count: int, given: Leaves) -> Solver:
    """Three bodies of the values of :func:`value_leaves`."""
    part = count // 3
    ground = Snow(
        given["soil_mu"],
        given["soil_lam"],
        given["compression"],
        given["stretch"],
        given["hardening"],
        (0.5, 2.0),
        1e-3,
    )
    sheet = VonMises(given["mu"], given["lam"], given["yield_stress"])
    bodies = (
        Body(part, sheet, given["mass"], given["volume"], muscle=True),
        Body(part, ground, given["soil_mass"]),
        Body(part, Elastic(given["ball_mu"], 80.0), volume=given["ball_volume"]),
    )
    return robot(count, bodies=bodies, gravity=given["gravity"], rules=RULES[1:], damping=0.999)


def loss(final: ParticleState) -> Tensor:
    """A random combination of everything."""
    return combination(final, 20, x=1.0, v=0.2, C=0.01, F=1.0, Jp=1.0)


def gradients(
    solver: Callable[[Leaves], Solver], given: Leaves, wanted: tuple[str, ...], substeps: int, backend: str
) -> Leaves:
    """Derivatives of :func:`loss` in what is wanted."""
    given = {name: value.detach().clone().requires_grad_(name in wanted) for name, value in given.items()}
    start = ParticleState(*(given[name] for name in STATE))
    run = replace(solver(given), backend=backend)
    final = run.step(start, given["actuation"], substeps=substeps, origin=given["origin"])
    found = torch.autograd.grad(loss(final), [given[name] for name in wanted], allow_unused=True)
    return {n: torch.zeros_like(given[n]) if g is None else g for n, g in zip(wanted, found, strict=True)}


def assert_gradients_close(found: Leaves, expected: Leaves, tolerance: float) -> None:
    """Compare relative to the largest number of each."""
    for name, value in expected.items():
        error = (found[name] - value).abs().max().item() / max(value.abs().max().item(), 1e-12)
        assert found[name].shape == value.shape
        assert error <= tolerance, f"{name} differs by {error:.1e}"


def compare_gradients(
    solver: Callable[[Leaves], Solver], given: Leaves, wanted: tuple[str, ...], substeps: int, tolerance: float
) -> Leaves:
    """Those of the native backend with those of the eager one, which are returned."""
    found, expected = (gradients(solver, given, wanted, substeps, backend) for backend in ("native", "eager"))
    assert all(value.isfinite().all() for value in found.values())
    assert_gradients_close(found, expected, tolerance)
    return expected


def assert_broken_alone(solver: Solver, given: Leaves, tolerance: float) -> None:
    """The second of three robots harms no other: with and without it they have the same states and derivatives."""
    ends = []
    for chosen in ([0, 1, 2], [0, 2]):
        leaves = {name: value[chosen].requires_grad_() for name, value in given.items()}
        start = ParticleState(*(leaves[name] for name in STATE))
        final = solver.step(start, leaves["actuation"], substeps=3, origin=leaves["origin"])[[0, -1]]
        found = torch.autograd.grad(final.x.sum() + final.F.square().sum(), list(leaves.values()))
        ends.append((final.detach(), {name: value[[0, -1]] for name, value in zip(leaves, found, strict=True)}))
    (together, of_all), (apart, of_some) = ends
    assert_identical(together, apart)
    assert_gradients_close(of_all, of_some, tolerance)


@pytest.mark.parametrize("substeps", [1, 25])
@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("name", NAMES)
def test_in_state_actuation_and_origin(name: str, batch: int, substeps: int) -> None:
    given = state_leaves(COUNT, batch)
    expected = compare_gradients(lambda _: solvers(COUNT, batch)[name], given, tuple(given), substeps, 1e-10)
    assert expected["x"].abs().max() > 0


@pytest.mark.parametrize("batch", [1, 2])
def test_in_values(batch: int) -> None:
    given, wanted = state_leaves(COUNT, batch) | value_leaves(COUNT, batch), tuple(value_leaves(3, 1))
    expected = compare_gradients(lambda leaves: varied(COUNT, leaves), given, wanted, 25, 1e-9)
    assert all(value.abs().max() > 0 for value in expected.values()), "every value must matter in this scene"


@pytest.mark.parametrize("wanted", ["actuation", "mu", "gravity", "x", "origin"])
def test_in_one_thing_alone(wanted: str) -> None:
    given = state_leaves(60, 2) | value_leaves(60, 2)
    compare_gradients(lambda leaves: varied(60, leaves), given, (wanted,), 5, 1e-10)


def corner_leaves() -> Leaves:
    """At rest: F = I, F = 0, rotations, det F = 0, mirrored, and at the bounds of soil."""
    F = torch.eye(2, dtype=torch.float64).repeat(1, 12, 1, 1)
    F[0, 1], F[0, 2], F[0, 3] = 0.0, torch.tensor([[0.0, -1.0], [1.0, 0.0]]), torch.tensor([[1.0, 0.0], [0.0, -1.0]])
    F[0, 4], F[0, 5] = torch.tensor([[1.0, 0.0], [0.0, 0.0]]), torch.tensor([[1.0, 1e-7], [0.0, 1.0]])
    F[0, 6], F[0, 7] = 0.975 * F[0, 6], 1.0045 * F[0, 7]
    state = replace(ParticleState.at_rest(lively(12).x), F=F)
    given = {name: getattr(state, name) for name in STATE}
    return given | {"actuation": torch.zeros(1, 2, 16, 16).double(), "origin": torch.zeros(1, 2).double()}


@pytest.mark.parametrize("material", [Elastic(300.0, 80.0), VonMises(500.0, 50.0, 60.0), Snow(800.0, 500.0)])
def test_corners_have_the_derivatives_of_the_plain_substep(material: Elastic) -> None:
    solver = robot(12, bodies=(Body(12, material, muscle=True),))
    compare_gradients(lambda _: solver, corner_leaves(), STATE, 1, 1e-10)


def test_friction_that_just_stops_a_node_has_the_derivative_of_sliding() -> None:
    particle = ParticleState.at_rest(torch.tensor([[[0.5, 0.5]]], dtype=torch.float64))
    found = []
    for backend in ("native", "eager"):
        v = torch.tensor([[[1.0, -1.0]]], dtype=torch.float64, requires_grad=True)
        body, rule = Body(1, Elastic(0.0, 0.0)), VelocityRule("-y", friction=1.0)
        final = Solver(Grid(8), (body,), rules=(rule,), backend=backend).step(replace(particle, v=v))
        assert not final.v.any()
        found.append(torch.autograd.grad(final.v[..., 0].sum(), v)[0])
    torch.testing.assert_close(*found)
    assert found[0].tolist() == [[[pytest.approx(1.0), pytest.approx(1.0)]]]


def cut(patch: pytest.MonkeyPatch, solver: Solver, count: int, substeps: int) -> None:
    """Cut long steps with gradients into pieces of so many substeps."""
    limit = solver.kernels.tape_limit(torch.empty(13, 1, count).double())
    patch.setattr(kernels, "TAPE_BYTES", substeps * kernels.TAPE_BYTES // limit)


@pytest.mark.parametrize("pieces", [False, True])
@pytest.mark.parametrize(("batch", "dtype"), [(1, torch.float64), (3, torch.float64), (3, torch.float32)])
def test_threads_make_no_difference(
    batch: int, dtype: torch.dtype, pieces: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit by bit: sums are taken in one order, also over the particles or simulations that share a constant."""
    given = state_leaves(2700, batch) | value_leaves(2700, batch)
    leaves = {name: value.to(dtype).requires_grad_() for name, value in given.items()}
    start, solver = ParticleState(*(leaves[name] for name in STATE)), replace(varied(2700, leaves), backend="native")
    results = []
    if pieces:
        cut(monkeypatch, solver, 2700, 3)
    for threads in (1, 2, 2, 5):
        torch.set_num_threads(threads)
        final = solver.step(start, leaves["actuation"], substeps=8, origin=leaves["origin"])
        results.append((final.stack(), *torch.autograd.grad(loss(final), list(leaves.values()))))
    for result in results[1:]:
        assert all(map(torch.equal, result, results[0]))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_a_simulation_alone_has_the_gradients_it_has_in_a_batch(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bit by bit, in pieces of a step, in all that belongs to one simulation."""
    given = state_leaves(300, 3) | value_leaves(300, 3)
    wanted = [name for name, value in given.items() if value.shape[:1] == (3,)]
    cut(monkeypatch, replace(varied(300, given), backend="native"), 300, 3)

    def slopes(chosen: slice) -> tuple[Tensor, ...]:
        leaves = given | {name: given[name][chosen].clone().requires_grad_() for name in wanted}
        start, solver = ParticleState(*(leaves[name] for name in STATE)), replace(varied(300, leaves), backend="native")
        final = solver.step(start, leaves["actuation"], substeps=8, origin=leaves["origin"])
        return torch.autograd.grad(final.stack().square().sum(), [leaves[name] for name in wanted])

    torch.set_num_threads(threads)
    together, alone = slopes(slice(None)), [slopes(slice(i, i + 1)) for i in range(3)]
    assert all(map(torch.equal, together, map(torch.cat, zip(*alone, strict=True))))


def test_long_steps_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """With gradients to bound the tape, without them so that Ctrl-C is heard; neither changes anything."""
    given, solver = state_leaves(60, 2), replace(solvers(60, 2)["three bodies"], backend="native")
    calls, forward = [], kernels.forward
    monkeypatch.setattr(kernels, "forward", lambda *arguments: calls.append(arguments[-1]) or forward(*arguments))

    def results() -> tuple[Leaves, ParticleState]:
        start = ParticleState(*(given[name] for name in STATE))
        end = solver.step(start, given["actuation"], substeps=10, origin=given["origin"])
        return gradients(lambda _: solver, given, ("x", "v", "actuation", "origin"), 10, "native"), end

    slopes, end = results()
    cut(monkeypatch, solver, 60, 4)
    monkeypatch.setattr(kernels, "MIN_SUBSTEPS", 3)
    slopes_in_pieces, end_in_pieces = results()
    assert calls == [10, 10, *(3, 3, 3, 1), *(4, 4, 2)]
    assert_identical(end_in_pieces, end)
    assert_gradients_close(slopes_in_pieces, slopes, 1e-14)


@pytest.mark.filterwarnings("ignore:There is a performance drop")  # torch's own: it takes row by row
def test_a_whole_jacobian_at_once() -> None:
    state = lively(10)

    def centre(v: Tensor, mu: Tensor) -> Tensor:
        solver = robot(10, bodies=(Body(10, Elastic(mu, 80.0)),), backend="native")
        return solver.step(replace(state, v=v), substeps=2).x.mean(1)[0]

    leaves = state.v, torch.tensor(500.0, dtype=torch.float64)
    rows, whole = (torch.autograd.functional.jacobian(centre, leaves, vectorize=v) for v in (False, True))
    assert all(map(torch.equal, rows, whole)) and all(jacobian.abs().max() > 0 for jacobian in whole)


def test_second_derivatives_are_refused() -> None:
    v = lively(10).v.clone().requires_grad_()
    final = robot(10, backend="native").step(replace(lively(10), v=v), substeps=2)
    (first,) = torch.autograd.grad(final.x.square().sum(), v, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(first.sum(), v)
