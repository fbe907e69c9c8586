"""Balances against plain sums."""

import math

import pytest
import torch
from scenes import GRID, lively, robot_and_ball

from torchmpm import ParticleState, diagnostics

H = GRID.h
N = 50


@pytest.fixture
def state() -> ParticleState:
    return lively(N, 2)


SOLVER = robot_and_ball(30, 20)
MASS = torch.tensor([2.0] * 30 + [5.0] * 20, dtype=torch.float64)
VOLUME = torch.tensor([1.0] * 30 + [1.5] * 20, dtype=torch.float64)


def test_mass_and_momentum(state: ParticleState) -> None:
    assert torch.equal(diagnostics.masses(SOLVER, state), MASS.expand(2, N))
    assert diagnostics.mass(SOLVER, state).tolist() == [160.0, 160.0]
    expected = torch.einsum("n,bni->bi", MASS, state.v)
    torch.testing.assert_close(diagnostics.momentum(SOLVER, state), expected)


def test_what_is_outside_the_window_does_not_move(state: ParticleState) -> None:
    origin = torch.stack((torch.zeros(2, dtype=torch.float64), state.x[1].mean(0)))
    inside = diagnostics.inside(SOLVER, state, origin)
    moved = (SOLVER.step(state, substeps=2, origin=origin).x != state.x).any(-1)
    assert torch.equal(inside, moved) and inside[0].all() and 0 < inside[1].sum() < N
    assert torch.equal(diagnostics.inside(SOLVER, state)[0], inside[0])


def test_angular_momentum_of_a_rigid_rotation() -> None:
    """Of a lattice about the origin: inertia times angular velocity, where a particle has m (r^2 + h^2 / 2)."""
    state = lively(N)
    omega = 3.0
    spin = torch.tensor([[0.0, -omega], [omega, 0.0]], dtype=torch.float64)
    rigid = ParticleState(state.x, state.x @ spin.T, spin.expand(1, N, 2, 2), state.F, state.Jp)
    inertia = (MASS * (state.x.square().sum(-1) + H**2 / 2)).sum(-1)
    torch.testing.assert_close(diagnostics.angular_momentum(SOLVER, rigid), omega * inertia)


def test_energies(state: ParticleState) -> None:
    kinetic = 0.5 * (MASS * state.v.square().sum(-1)).sum(-1)
    torch.testing.assert_close(diagnostics.kinetic_energy(SOLVER, state), kinetic)
    potential = -(MASS * (0.5 * state.x[..., 0] - 9.8 * state.x[..., 1])).sum(-1)
    torch.testing.assert_close(diagnostics.potential_energy(SOLVER, state), potential)
    assert diagnostics.potential_energy(SOLVER, state).min() > 0, "height counts positive"

    U, _, Vh = torch.linalg.svd(state.F)
    distance = (state.F - U @ Vh).square().sum((-1, -2))
    dilation = (torch.linalg.det(state.F) - 1.0).square()
    mu, lam = (torch.tensor([a] * 30 + [b] * 20, dtype=torch.float64) for a, b in ((500.0, 300.0), (50.0, 80.0)))
    elastic = (VOLUME * (mu * distance + 0.5 * lam * dilation)).sum(-1)
    torch.testing.assert_close(diagnostics.elastic_energy(SOLVER, state), elastic)


@pytest.mark.parametrize("name", ["x", "v", "C", "F", "Jp"])
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_finite(state: ParticleState, name: str, number: float) -> None:
    assert state.is_finite().tolist() == [True, True]
    field = getattr(state, name).clone()
    field[1, -1] = number
    broken = ParticleState(**{n: getattr(state, n) for n in ("x", "v", "C", "F", "Jp")} | {name: field})
    assert broken.is_finite().tolist() == [True, False]


def test_impulses_of_gravity_and_damping(state: ParticleState) -> None:
    """In free space m g dt, and a share of what is there after it."""
    solver = robot_and_ball(30, 20, rules=(), damping=0.9)
    found = diagnostics.impulses(solver, state)
    gravity = 160.0 * 1e-4 * torch.tensor([0.5, -9.8], dtype=torch.float64)
    assert set(found) == {"gravity", "damping", "boundary"}
    torch.testing.assert_close(found["gravity"], gravity.expand(2, 2), rtol=1e-9, atol=0)
    damping = -0.1 * (diagnostics.momentum(solver, state) + gravity)
    torch.testing.assert_close(found["damping"], damping, rtol=1e-9, atol=0)
    assert (found["boundary"] == 0).all()
