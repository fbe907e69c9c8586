"""Both transfers on affine velocity fields."""

import torch
from scenes import GRID, lively, normal

from torchmpm import transfer
from torchmpm.transfer import stencil

R, H = GRID.resolution, GRID.h


def test_affine_fields_pass_through_both_transfers() -> None:
    """APIC: v = a + B x on the particles gives a + B x_i on the nodes, and comes back with C = B."""
    state = lively(200)
    B = normal(2, 2, seed=6)
    v = torch.tensor([0.3, -0.1], dtype=torch.float64) + state.x @ B.T
    planes = state.components()
    nodes = stencil(GRID, planes[0], planes[1], torch.zeros(1, 2, dtype=torch.float64))
    ones, none = torch.ones(1, 200, dtype=torch.float64), torch.zeros(1, 200, dtype=torch.float64)
    C = tuple(b.expand(1, 200) for b in B.flatten())
    grid = transfer.particles_to_grid(GRID, nodes, ones, v.unbind(-1), C, 2.0 * ones, (none, none, none))
    back, slope = transfer.grid_to_particles(GRID, nodes, grid[1:] / grid[0].clamp_min(1e-300))
    torch.testing.assert_close(torch.stack(back, -1), v, rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.stack(slope, -1), B.flatten().expand(1, 200, 4), rtol=0, atol=1e-11)
