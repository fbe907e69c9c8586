"""Quadratic B-spline weights, node addresses, and the scatter and gather built on them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm.grid import PAD, Grid


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
