"""The two transfers against loops over particles and nodes."""

import math

import torch
from scenes import GRID, lively, normal
from torch import Tensor

from torchmpm import transfer
from torchmpm.grid import PAD
from torchmpm.spline import stencil

R, H = GRID.resolution, GRID.h


def around(position: Tensor) -> list[tuple[int, int, float, Tensor]]:
    """Nodes (i, j), weights and offsets in metres of one particle, after mpm.md 3."""
    u = (position / H).tolist()
    base = [math.trunc(c - 0.5) for c in u]
    f = [c - b for c, b in zip(u, base, strict=True)]
    weights = [(0.5 * (1.5 - g) ** 2, 0.75 - (g - 1) ** 2, 0.5 * (g - 0.5) ** 2) for g in f]
    return [
        (
            base[0] + p,
            base[1] + q,
            weights[0][p] * weights[1][q],
            torch.tensor([(p - f[0]) * H, (q - f[1]) * H], dtype=torch.float64),
        )
        for p in range(3)
        for q in range(3)
    ]


def nodes_only(field: Tensor) -> Tensor:
    return field.unflatten(-1, (GRID.width, GRID.width))[..., PAD:-PAD, PAD:-PAD]


def test_particles_to_grid_against_a_loop() -> None:
    state = lively(12, 2)
    mass = 1.0 + normal(1, 12, seed=1).abs()
    force = tuple(normal(2, 12, seed=seed) for seed in (2, 3, 4))
    active = torch.ones(2, 12, dtype=torch.float64)
    active[1, 5] = 0.0
    planes = state.planes()
    nodes = stencil(GRID, planes[0], planes[1], torch.zeros(2, 2, dtype=torch.float64))
    found = nodes_only(transfer.particles_to_grid(GRID, nodes, active, planes[2:4], planes[4:8], mass, force))

    expected = torch.zeros(3, 2, R, R, dtype=torch.float64)
    for b in range(2):
        for n in range(12):
            if not active[b, n]:
                continue
            xx, xy, yy = (f[b, n] for f in force)
            P = mass[0, n] * state.C[b, n] + torch.stack((xx, xy, xy, yy)).view(2, 2)
            for i, j, w, d in around(state.x[b, n]):
                expected[0, b, i, j] += w * mass[0, n]
                expected[1:, b, i, j] += w * (mass[0, n] * state.v[b, n] + P @ d)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)


def test_grid_to_particles_against_a_loop() -> None:
    state = lively(12, 2, seed=1)
    planes = state.planes()
    nodes = stencil(GRID, planes[0], planes[1], torch.zeros(2, 2, dtype=torch.float64))
    velocity = normal(2, 2, GRID.width**2, seed=5)
    (vx, vy), C = transfer.grid_to_particles(GRID, nodes, velocity)
    at_nodes = nodes_only(velocity)
    for b in range(2):
        for n in range(12):
            v, affine = torch.zeros(2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
            for i, j, w, d in around(state.x[b, n]):
                v += w * at_nodes[:, b, i, j]
                affine += 4.0 / H**2 * w * torch.outer(at_nodes[:, b, i, j], d)
            torch.testing.assert_close(torch.stack((vx, vy))[:, b, n], v, rtol=0, atol=1e-13)
            torch.testing.assert_close(torch.stack(C)[:, b, n].view(2, 2), affine, rtol=0, atol=1e-12)


def test_affine_fields_pass_through_both_transfers() -> None:
    """APIC: v = a + B x on the particles gives a + B x_i on the nodes, and comes back with C = B."""
    state = lively(200)
    B = normal(2, 2, seed=6)
    v = torch.tensor([0.3, -0.1], dtype=torch.float64) + state.x @ B.T
    planes = state.planes()
    nodes = stencil(GRID, planes[0], planes[1], torch.zeros(1, 2, dtype=torch.float64))
    ones, none = torch.ones(1, 200, dtype=torch.float64), torch.zeros(1, 200, dtype=torch.float64)
    C = tuple(b.expand(1, 200) for b in B.flatten())
    grid = transfer.particles_to_grid(GRID, nodes, ones, v.unbind(-1), C, 2.0 * ones, (none, none, none))
    back, slope = transfer.grid_to_particles(GRID, nodes, grid[1:] / grid[0].clamp_min(1e-300))
    torch.testing.assert_close(torch.stack(back, -1), v, rtol=0, atol=1e-12)
    torch.testing.assert_close(torch.stack(slope, -1), B.flatten().expand(1, 200, 4), rtol=0, atol=1e-11)
