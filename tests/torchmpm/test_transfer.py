"""Weights and addresses of particles anywhere, and both transfers on affine velocity fields."""

import math

import pytest
import scenes
import torch
from scenes import normal

from torchmpm.grid import PAD, Grid
from torchmpm.transfer import grid_to_particles, particles_to_grid, scatter, stencil

R = 8
GRID = Grid(R, spacing=0.25)
#: Positions in cells around every place where something changes, far beyond, and none at all.
PLACES = [-40.0, -3.6, -3.5, -3.2, -2.5, -2.4, -1.6, -1.5, -1.2, -0.6, -0.5, -0.3, 0.0, 0.2, 0.5, 0.7, 1.49, 1.5, 3.3]
PLACES += [R - 2.5, R - 2.1, R - 1.5, R - 1.4, R - 1.0, R - 0.5, R - 0.2, float(R), R + 0.4, R + 0.5, R + 2.7, R + 3.5]
PLACES += [R + 30.0, 1e12, -1e12, math.nan, math.inf, -math.inf]


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("place", PLACES)
def test_scatter_of_one_particle_anywhere(axis: int, place: float) -> None:
    """Each node that exists gets its weight, all else is dropped: nothing is stored at a foreign node."""
    u = [3.3, 3.3]
    u[axis] = place
    x, y = (torch.tensor([[GRID.h * c]], dtype=torch.float64) for c in u)
    nodes = stencil(GRID, x, y, torch.zeros(1, 2, dtype=torch.float64))
    assert 0 <= nodes.ids.min() and nodes.ids.max() < nodes.cells == GRID.width**2

    expected = torch.zeros(R, R, dtype=torch.float64)
    base = [math.trunc(c - 0.5) if math.isfinite(c) else 2 * R for c in u]
    f = [c - b for c, b in zip(u, base, strict=True)]
    weights = [(0.5 * (1.5 - g) ** 2, 0.75 - (g - 1) ** 2, 0.5 * (g - 0.5) ** 2) for g in f]
    for p in range(3):
        for q in range(3):
            i, j = base[0] + p, base[1] + q
            if 0 <= i < R and 0 <= j < R:
                expected[i, j] = weights[0][p] * weights[1][q]
    found = scatter(nodes, nodes.weights[None])[0, 0].view(GRID.width, GRID.width)[PAD:-PAD, PAD:-PAD]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * max(1.0, expected.abs().max().item()))


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
