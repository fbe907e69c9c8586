"""Particles to grid and grid to particles (affine particle-in-cell, MLS-MPM) with quadratic B-splines."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm.grid import PAD, Grid
from torchmpm.materials.linalg import Mat2, Sym2


def quadratic_weights(f: Tensor) -> Tensor:
    """Weights (..., 3, N) of three nodes at f cells, (..., N), from the first (Jiang et al., 2015); they sum to one."""
    return torch.stack((0.5 * (1.5 - f).square(), 0.75 - (f - 1.0).square(), 0.5 * (f - 0.5).square()), dim=-2)


@dataclass(frozen=True, eq=False)
class Stencil:
    """The 3x3 nodes around each particle."""

    ids: Tensor  # (B, 9N) addresses in the padded grid: first offset p (x) slowest, then q (y), then particle
    wx: Tensor  # (B, 3, N) weights along each axis
    wy: Tensor
    fx: Tensor  # (B, N) distance from the first node in cells
    fy: Tensor
    cells: int  # number of addresses

    @property
    def weights(self) -> Tensor:
        """(B, 3, 3, N) products of the weights of both axes."""
        return self.wx[:, :, None] * self.wy[:, None]

    def part(self, particles: slice) -> "Stencil":
        """The stencils of some of the particles."""
        if particles == slice(0, self.fx.shape[-1]):
            return self
        ids = self.ids.unflatten(-1, (9, -1))[..., particles].flatten(-2)
        wx, wy, fx, fy = (t[..., particles] for t in (self.wx, self.wy, self.fx, self.fy))
        return Stencil(ids, wx, wy, fx, fy, self.cells)


def stencil(grid: Grid, x: Tensor, y: Tensor, origin: Tensor) -> Stencil:
    """Nodes and weights of particles at (x, y), (B, N) each, m, in windows at origin (B, 2), m.

    The base node is ``trunc(u - 1/2)`` like in the reference implementation of DittoGym: in the outermost half
    cell of the window the weights are extrapolated from the first three nodes.
    """
    node, weight, fraction = [], [], []
    for position, start in ((x, origin[:, 0:1]), (y, origin[:, 1:2])):
        u = (position - start) * (1.0 / grid.h)
        base = torch.trunc(u.detach() - 0.5)
        f = u - base
        f = torch.where(torch.isnan(f), 1.0, f)  # with a NaN position; it must not spoil derivatives that all share
        fraction.append(f)
        weight.append(quadratic_weights(f))
        # Clamped before the conversion, which is undefined for large numbers; NaN goes to the low end: padding.
        address = torch.where(base > -PAD, base, -PAD).clamp_max(grid.resolution)
        node.append(address.to(torch.int64) + PAD)
    offset = torch.arange(3, device=x.device)
    ids = (node[0][:, None, None] + offset[:, None, None]) * grid.width + node[1][:, None, None] + offset[:, None]
    return Stencil(ids.flatten(1), weight[0], weight[1], fraction[0], fraction[1], grid.width**2)


def scatter(stencil: Stencil, values: Tensor) -> Tensor:
    """Add particle contributions to nodes: (R, B, 3, 3, N) -> (R, B, cells)."""
    rows, batch = values.shape[:2]
    target = values.new_zeros(rows, batch, stencil.cells)
    return target.scatter_add(-1, stencil.ids.expand(rows, -1, -1), values.flatten(2))


def gather(stencil: Stencil, field: Tensor) -> Tensor:
    """Read node values at the stencils: (R, B, cells) -> (R, B, 3, 3, N)."""
    rows = field.shape[0]
    return torch.gather(field, -1, stencil.ids.expand(rows, -1, -1)).unflatten(-1, (3, 3, -1))


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
    """``v = sum w v_i`` and ``C = 4/h sum w v_i (offset in cells)^T`` from node velocities (2, B, cells)."""
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
    """Two components (B, N) of a field (2, B, cells) at the particles, for example of the muscle actuation."""
    first, second = (stencil.weights * gather(stencil, field)).sum((2, 3))
    return first, second
