"""Scenes at the limits: ends of the window, one cell, inversion, speed, nothing at all; and failures, alone."""

import math
from dataclasses import replace

import pytest
import scenes
import torch
from native_scenes import moving, solvers
from scenes import GRID, assert_identical, generator, lively, normal, positions, robot
from test_native_adjoint import STATE, state_leaves

from torchmpm import Body, Grid, ParticleState, Solver, VonMises, diagnostics

pytestmark = pytest.mark.usefixtures("backend")

H, MARGIN, SIZE = GRID.h, GRID.margin, 1.0
FREE = {"rules": (), "gravity": (0.0, 0.0)}


def free(count: int, **changes: object) -> Solver:
    """A robot in free space."""
    return robot(count, **{**FREE, "backend": scenes.BACKEND, **changes})


def placed(x: torch.Tensor, speed: float = 0.5, seed: int = 0) -> ParticleState:
    """Undeformed particles with random velocities."""
    state = ParticleState.at_rest(x)
    return replace(state, v=speed * normal(*x.shape, seed=seed))


@pytest.mark.parametrize("across", [0.3, 0.97, 1.05], ids=["inside", "at the top", "beyond the top"])
@pytest.mark.parametrize("edge", ["left", "right"])
@pytest.mark.parametrize("grid", [GRID, Grid(5, 0.1)], ids=["16 nodes", "5 nodes"])
def test_ends_of_the_window_in_x(grid: Grid, edge: str, across: float) -> None:
    """Up to the margin a particle rests as it is, from the next number on it takes part."""
    outside, width = grid.margin if edge == "left" else grid.extent, grid.resolution * grid.h
    inside = math.nextafter(outside, 0.5 * width)
    x = torch.tensor([[[outside, across * width], [inside, across * width]]], dtype=torch.float64)
    state = placed(x)
    result = free(2, grid=grid).step(state)
    assert_identical(part(result, 0), part(state, 0))
    if across > 1:
        assert_identical(part(result, 1), part(state, 1))
    else:
        assert (result.C[0, 1] != 0).any()
    assert result.is_finite().all()


def part(state: ParticleState, k: int) -> ParticleState:
    return ParticleState(*(getattr(state, name)[:, k : k + 1] for name in ("x", "v", "C", "F", "Jp")))


@pytest.mark.parametrize("corner", [(i, j) for i in (0, 1, 2) for j in (0, 1, 2) if (i, j) != (1, 1)])
def test_matter_at_every_edge(corner: tuple[int, int]) -> None:
    """Over the upper ends by a cell and on its way out, or at the lower ends and on its way in: nothing gets faster.

    Below half a cell from the lower ends weights are extrapolated.
    """
    places = torch.tensor([1.5 * H, 0.5, SIZE], dtype=torch.float64)
    numbers = torch.rand(1, 60, 2, generator=generator(1), dtype=torch.float64)
    x = places[list(corner)] + H * (2 * numbers - 1)
    upwards = torch.tensor([0.5 if c != 1 else 0.0 for c in corner], dtype=torch.float64)
    state = replace(ParticleState.at_rest(x), v=upwards.expand_as(x))
    result = free(60).step(state, substeps=20)
    assert result.is_finite().all()
    assert result.v.abs().max() <= 0.5 * (1 + 1e-6)


@pytest.mark.parametrize("spread", [0.0, 1e-12, 0.5], ids=["one point", "nearly one point", "one cell"])
def test_all_particles_in_one_cell(spread: float) -> None:
    """Momentum stays; from one point all go the same way."""
    x = 0.5 + 0.25 * H + spread * H * torch.rand(1, 200, 2, generator=generator(2), dtype=torch.float64)
    state, solver = placed(x), free(200)
    result = solver.step(state, 40.0 * normal(1, 2, 16, 16, seed=3), substeps=20)
    assert result.is_finite().all()
    torch.testing.assert_close(
        diagnostics.momentum(solver, result), diagnostics.momentum(solver, state), rtol=1e-9, atol=1e-9
    )
    if spread < 0.1:
        torch.testing.assert_close(result.x, state.x + 20 * 1e-4 * state.v.mean(1, keepdim=True), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["elastic", "von Mises", "soil"])
@pytest.mark.parametrize("kind", ["inverted", "flat", "point"])
def test_inverted_and_collapsed_elements(name: str, kind: str) -> None:
    """Numbers and momentum stay, and forces bounded: no particle is shot away."""
    solver, state = replace(solvers(60, 1)[name], rules=(), gravity=(0.0, 0.0), backend=scenes.BACKEND), lively(60)
    F = state.F.clone()
    F[:, ::2] = {"inverted": F[:, ::2].flip(-1), "flat": torch.ones(2, 2).double(), "point": 0.0 * F[:, ::2]}[kind]
    state = replace(state, F=F)
    result = solver.step(state, substeps=50)
    assert result.is_finite().all()
    momenta = [diagnostics.momentum(solver, s) for s in (state, result)]
    torch.testing.assert_close(*momenta, rtol=1e-8, atol=1e-8)
    assert result.v.abs().max() < 20.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("speed", [1e4, 1e8, 1e15])
def test_huge_velocities(speed: float, dtype: torch.dtype) -> None:
    """Whoever leaves the window in x rests where it got to; all numbers stay numbers."""
    state = placed(positions(50), speed).to(dtype)
    solver = free(50)
    once = solver.step(state)
    result = solver.step(once, substeps=20)
    assert result.is_finite().all()
    left = ~GRID.contains(once.x[..., 0], torch.zeros(1, 1, dtype=dtype))
    assert left.any()
    for name in ("x", "v", "C", "F"):
        assert torch.equal(getattr(result, name)[left], getattr(once, name)[left]), name


def test_an_empty_batch_stays_empty() -> None:
    state = lively(20, 2)[:0]
    result = robot(20).step(state, torch.zeros(0, 2, 16, 16, dtype=torch.float64), substeps=3)
    assert result.x.shape == (0, 20, 2) and result.F.shape == (0, 20, 2, 2)
    assert result.is_finite().shape == (0,)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -1e30])
@pytest.mark.parametrize("name", [*STATE, "actuation", "origin"])
def test_a_broken_element_harms_no_other(name: str, value: float) -> None:
    """Not by a bit, in states and derivatives, wherever the number is; and it stays broken, it is not hidden."""
    solver, results = replace(solvers(30, 3)["three bodies"], backend=scenes.BACKEND), []
    for broken in (False, True):
        given = {key: tensor.clone() for key, tensor in state_leaves(30, 3).items()}
        if broken:
            given[name][1].view(-1)[:: 5 if name != "origin" else 1] = value
        start = ParticleState(*(given[key].requires_grad_() for key in STATE))
        field, origin = given["actuation"].requires_grad_(), given["origin"].requires_grad_()
        final = solver.step(start, field, substeps=15, origin=origin)
        loss = final.x.square().sum() + final.F.square().sum()
        results.append((final, torch.autograd.grad(loss, list(given.values()))))
    (sound, slopes), (beside, others) = results
    for i in (0, 2):
        assert_identical(beside[i], sound[i])
        assert all(torch.equal(one[i], other[i]) for one, other in zip(slopes, others, strict=True))
    assert all(slope.abs().max() > 0 for slope in slopes)
    if name in ("v", "C", "F") and abs(value) != 1e30:
        assert not beside[1].is_finite()


@pytest.mark.parametrize("axis", [0, 1])
def test_a_particle_at_no_place_harms_no_other(axis: int) -> None:
    """It is as good as far away, for values and derivatives, also of particles below the window."""
    results = []
    for place in (-50.0, math.nan):
        state, rest = lively(20), [k for k in range(20) if k != 3]
        x, mu = state.x.clone(), torch.tensor(500.0, dtype=torch.float64, requires_grad=True)
        x[0, 5:8, 1] -= 0.5
        x[0, 3, 0 if place == place else axis] = place
        x, v = x.requires_grad_(), state.v.requires_grad_()
        body = Body(20, VonMises(mu, 50.0, 60.0), mass=2.0)
        final = robot(20, bodies=(body,)).step(replace(state, x=x, v=v), substeps=4)
        loss = sum(getattr(final, name)[:, rest].square().sum() for name in ("x", "v", "F"))
        of_x, of_v, of_mu = torch.autograd.grad(loss, (x, v, mu))
        results.append((loss.detach(), of_x[:, rest], of_v[:, rest], of_mu))
    for beside, alone in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(beside, alone, rtol=1e-10, atol=0)


def test_matter_that_leaves_the_window_does_not_explode() -> None:
    """To the left, right, bottom and top; below, weights are extrapolated, and some of it gets faster."""
    block = 0.45 + 0.1 * torch.rand(1, 100, 2, generator=generator(1), dtype=torch.float64)
    outwards = torch.tensor([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)], dtype=torch.float64)[:, None]
    state = placed(block + 0.3 * outwards)
    final = free(100).step(replace(state, v=state.v + 8.0 * outwards), substeps=1100)
    assert final.x.isfinite().all() and final.x.abs().max() < 2.0 and final.v.abs().max() < 60.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", ["x", "y", "outside", "at the edge"])
@pytest.mark.parametrize("name", ["elastic", "von Mises", "soil"])
def test_particles_outside_the_window_have_no_gradient(name: str, place: str, value: float) -> None:
    """At no place, or outside with a state that is no number: constants that all share are differentiated as without.

    And the particle keeps what it has.
    """
    solver, results = replace(solvers(21, 1)[name], backend=scenes.BACKEND), []
    for broken in (False, True):
        state, field, origin = moving(21, 2)
        state, field, origin = state.clone(), field.clone(), torch.zeros_like(origin)
        state.x[0, 3] = torch.tensor([SIZE if place == "at the edge" else 9.0, 0.5])
        if broken and place in ("x", "y"):
            state.x[0, 3] = 0.5
            state.x[0, 3, "xy".index(place)] = value
        elif broken:
            for plane in (state.v, state.C, state.F, state.Jp):
                plane[0, 3] = value
        constants = {n: torch.tensor(v, dtype=torch.float64) for n, v in (("mu", 500.0), ("lam", 80.0), ("mass", 2.0))}
        constants |= {"volume": torch.tensor(1.0).double(), "gravity": torch.tensor([0.5, -9.8]).double()}
        wanted = [tensor.requires_grad_() for tensor in (*constants.values(), field)]
        (body,) = solver.bodies
        law = replace(body.material, mu=constants["mu"], lam=constants["lam"])
        body = replace(body, material=law, mass=constants["mass"], volume=constants["volume"])
        final = replace(solver, bodies=(body,), gravity=constants["gravity"]).step(
            state, field, substeps=4, origin=origin
        )
        for one, other in zip(part(final, 3).components(), part(state, 3).components(), strict=True):
            torch.testing.assert_close(one[0], other[0], rtol=0, atol=0, equal_nan=True)
        loss = sum(getattr(final, n)[1].square().sum() for n in ("x", "v", "F", "Jp"))
        results.append(torch.autograd.grad(loss, wanted, materialize_grads=True))
        assert (results[-1][-1][0] == 0).all()
    for beside, without in zip(*reversed(results), strict=True):
        assert without.abs().max() > 0 or name != "von Mises"
        torch.testing.assert_close(beside, without, rtol=1e-12, atol=0)


def test_no_actuation_reaches_what_takes_no_part() -> None:
    """Nor its derivative, if that is no number where such a particle is."""
    gradients = []
    for value in (0.0, math.nan):
        state, volume = lively(10, 2), torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
        state.x[0] = torch.tensor([SIZE - 0.5 * MARGIN, 0.5])
        field = 40.0 * normal(2, 2, 16, 16, seed=1)
        field[0] = value
        body = Body(10, VonMises(500.0, 50.0, 60.0), mass=2.0, volume=volume, muscle=True)
        final = robot(10, bodies=(body,)).step(state, field, substeps=3)
        gradients += torch.autograd.grad(final.F[1].square().sum(), volume)
    assert gradients[0] == gradients[1] != 0
