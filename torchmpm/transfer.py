"""Particles to grid and grid to particles (affine particle-in-cell, MLS-MPM)."""

import torch
from torch import Tensor

from torchmpm.grid import Grid
from torchmpm.materials.linalg import Mat2, Sym2
from torchmpm.spline import Stencil, gather, scatter


def particles_to_grid(
    grid: Grid, stencil: Stencil, active: Tensor, v: tuple[Tensor, Tensor], C: Mat2, mass: Tensor, stress_momentum: Sym2
) -> Tensor:
    """Mass and momentum (3, B, cells) on the nodes after the internal forces of one substep.

    A node at the offset d from a particle receives ``w m`` and ``w (m v + P d)`` with ``P = m C - dt V 4/h^2 tau``
    (Hu et al., "A moving least squares material point method", 2018). ``active`` (B, N) is 1 for particles that take
    part, else 0; ``stress_momentum`` is ``-dt V 4/h^2 tau``, kg/s.
    """
    offset = torch.arange(3, device=active.device, dtype=active.dtype)[:, None]
    dx, dy = (offset - stencil.fx[:, None]) * grid.h, (offset - stencil.fy[:, None]) * grid.h
    xx, xy = stress_momentum[0] + mass * C[0], stress_momentum[1] + mass * C[1]
    yx, yy = stress_momentum[1] + mass * C[2], stress_momentum[2] + mass * C[3]
    weight = (stencil.wx * active[:, None])[:, :, None] * stencil.wy[:, None]
    momentum_x = ((mass * v[0])[:, None] + xx[:, None] * dx)[:, :, None] + (xy[:, None] * dy)[:, None]
    momentum_y = ((mass * v[1])[:, None] + yx[:, None] * dx)[:, :, None] + (yy[:, None] * dy)[:, None]
    masses = weight * mass[:, None, None]
    return scatter(stencil, torch.stack((masses, weight * momentum_x, weight * momentum_y)))


def grid_to_particles(grid: Grid, stencil: Stencil, velocity: Tensor) -> tuple[tuple[Tensor, Tensor], Mat2]:
    """Planes of ``v = sum w v_i`` and ``C = 4/h sum w v_i (offset in cells)^T`` from node velocities (2, B, cells)."""
    nodes = gather(stencil, velocity)
    offset = torch.arange(3, device=velocity.device, dtype=velocity.dtype)[:, None]
    wy_dy = stencil.wy * (offset - stencil.fy[:, None])
    wx_dx = stencil.wx * (offset - stencil.fx[:, None])
    row = (nodes * stencil.wy[:, None]).sum(3)  # (2, B, 3, N): summed over y
    v = (row * stencil.wx).sum(2)
    slope_x = (row * wx_dx).sum(2) * (4.0 / grid.h)
    slope_y = ((nodes * wy_dy[:, None]).sum(3) * stencil.wx).sum(2) * (4.0 / grid.h)
    return (v[0], v[1]), (slope_x[0], slope_y[0], slope_x[1], slope_y[1])


def interpolate(stencil: Stencil, field: Tensor) -> tuple[Tensor, Tensor]:
    """Two planes (B, N) of a field (2, B, cells) at the particles, for example of the muscle actuation."""
    first, second = (stencil.weights * gather(stencil, field)).sum((2, 3))
    return first, second
