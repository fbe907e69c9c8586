"""Weights, addresses, scatter as the transpose of gather, and both transfers on affine velocity fields."""

import math

import pytest
import scenes
import torch
from hypothesis import given
from hypothesis import strategies as st
from scenes import normal

from torchmpm.grid import PAD, Grid
from torchmpm.transfer import (
    Stencil,
    gather,
    grid_to_particles,
    particles_to_grid,
    quadratic_weights,
    scatter,
    stencil,
)

R = 8
GRID = Grid(R, spacing=0.25)
#: Positions in cells around every place where something changes, and far beyond.
PLACES = [-40.0, -3.6, -3.5, -3.2, -2.5, -2.4, -1.6, -1.5, -1.2, -0.6, -0.5, -0.3, 0.0, 0.2, 0.5, 0.7, 1.49, 1.5, 3.3]
PLACES += [R - 2.5, R - 2.1, R - 1.5, R - 1.4, R - 1.0, R - 0.5, R - 0.2, float(R), R + 0.4, R + 0.5, R + 2.7, R + 3.5]
PLACES += [R + 30.0, 1e12, -1e12]


def at(u: torch.Tensor, v: torch.Tensor, origin: tuple[float, float] = (0.0, 0.0)) -> Stencil:
    """Stencils of the points (u, v), each (B, N), in cells from the window's corner."""
    corner = torch.tensor(origin, dtype=u.dtype).expand(u.shape[0], 2)
    return stencil(GRID, corner[:, :1] + GRID.h * u, corner[:, 1:] + GRID.h * v, corner)


def existing(field: torch.Tensor) -> torch.Tensor:
    """(..., cells) -> (..., R, R), without the padding."""
    return field.unflatten(-1, (GRID.width, GRID.width))[..., PAD:-PAD, PAD:-PAD]


@given(st.floats(-2.0, 3.0))
def test_moments_of_the_weights(f: float) -> None:
    """For every f, also where the window's edge extrapolates: sum 1, centre f, inertia 1/4 (the 4/h^2 of APIC)."""
    w = quadratic_weights(torch.tensor([f], dtype=torch.float64))[:, 0]
    offset = torch.arange(3, dtype=torch.float64) - f
    assert w.sum().item() == pytest.approx(1.0, abs=1e-14)
    assert (w * offset).sum().item() == pytest.approx(0.0, abs=1e-13)
    assert (w * offset**2).sum().item() == pytest.approx(0.25, abs=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("place", PLACES)
def test_scatter_of_one_particle_anywhere(axis: int, place: float) -> None:
    """Each node that exists gets its weight, all else is dropped: nothing is stored at a foreign node."""
    u = [3.3, 3.3]
    u[axis] = place
    nodes = at(*(torch.tensor([[c]], dtype=torch.float64) for c in u))
    assert 0 <= nodes.ids.min() and nodes.ids.max() < nodes.cells == GRID.width**2

    expected = torch.zeros(R, R, dtype=torch.float64)
    base = [math.trunc(c - 0.5) for c in u]
    f = [c - b for c, b in zip(u, base, strict=True)]
    weights = [(0.5 * (1.5 - g) ** 2, 0.75 - (g - 1) ** 2, 0.5 * (g - 0.5) ** 2) for g in f]
    for p in range(3):
        for q in range(3):
            i, j = base[0] + p, base[1] + q
            if 0 <= i < R and 0 <= j < R:
                expected[i, j] = weights[0][p] * weights[1][q]
    found = existing(scatter(nodes, nodes.weights[None]))[0, 0]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * max(1.0, expected.abs().max().item()))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_has_an_address_and_no_effect(axis: int, number: float) -> None:
    u = [3.3, 3.3]
    u[axis] = number
    nodes = at(*(torch.tensor([[c]], dtype=torch.float64) for c in u))
    assert 0 <= nodes.ids.min() and nodes.ids.max() < nodes.cells
    assert torch.equal(existing(scatter(nodes, nodes.weights[None])), torch.zeros(1, 1, R, R, dtype=torch.float64))


def test_origin_shifts_each_simulation() -> None:
    u, v = torch.full((2, 1), 3.3, dtype=torch.float64), torch.full((2, 1), 4.4, dtype=torch.float64)
    origin = torch.tensor([[0.0, 0.0], [GRID.h, -2 * GRID.h]], dtype=torch.float64)
    nodes = stencil(GRID, GRID.h * u, GRID.h * v, origin)
    first, second = nodes.ids.view(2, 3, 3)
    assert torch.equal(second, first - GRID.width + 2)
    torch.testing.assert_close(nodes.weights[1], nodes.weights[0], rtol=0, atol=1e-14)
    moved = at(u, v, origin=(-3.7, 11.2))
    assert torch.equal(moved.ids.view(2, 3, 3)[0], first)


def scattered(seed: int, batch: int = 2, count: int = 30) -> Stencil:
    """Stencils of particles all over the window and beyond its edges."""
    spread = 3.5 + 3.0 * normal(2, batch, count, seed=seed)
    return at(spread[0], spread[1])


@pytest.mark.parametrize("seed", range(3))
def test_scatter_is_the_transpose_of_gather(seed: int) -> None:
    nodes = scattered(seed)
    values, field = normal(2, 2, 3, 3, 30, seed=seed + 10), normal(2, 2, nodes.cells, seed=seed + 20)
    spread, read = scatter(nodes, values), gather(nodes, field)
    assert spread.shape == field.shape
    assert read.shape == values.shape
    assert (spread * field).sum().item() == pytest.approx((values * read).sum().item(), rel=1e-12)


def test_gradient_of_the_weights() -> None:
    """Also across the place where the three nodes change, because the spline is smooth there."""
    x = torch.tensor([[0.3, 1.1, 1.37, 1.62]], dtype=torch.float64, requires_grad=True)
    origin = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    field = normal(1, 1, GRID.width**2, seed=4)

    def read(x: torch.Tensor, origin: torch.Tensor) -> torch.Tensor:
        nodes = stencil(GRID, x, x.flip(-1), origin)
        return (nodes.weights * gather(nodes, field)).sum((2, 3))

    assert torch.autograd.gradcheck(read, (x, origin))


def test_affine_fields_pass_through_both_transfers() -> None:
    """APIC: v = a + B x on the particles gives a + B x_i on the nodes, and comes back with C = B."""
    state = scenes.lively(200)
    B = normal(2, 2, seed=6)
    v = torch.tensor([0.3, -0.1], dtype=torch.float64) + state.x @ B.T
    x, y, *_ = state.components()
    nodes = stencil(scenes.GRID, x, y, torch.zeros(1, 2, dtype=torch.float64))
    ones, none = torch.ones(1, 200, dtype=torch.float64), torch.zeros(1, 200, dtype=torch.float64)
    C = tuple(b.expand(1, 200) for b in B.flatten())
    grid = particles_to_grid(scenes.GRID, nodes, ones, v.unbind(-1), C, 2.0 * ones, (none, none, none))
    back, slope = grid_to_particles(scenes.GRID, nodes, grid[1:] / grid[0].clamp_min(1e-300))
    torch.testing.assert_close(torch.stack(back, -1), v, rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.stack(slope, -1), B.flatten().expand(1, 200, 4), rtol=0, atol=1e-11)
