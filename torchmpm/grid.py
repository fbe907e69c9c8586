"""The background grid: a square window of nodes that may follow the particles."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm import checks, tree

#: Rows of nodes kept around the window so that every 3x3 stencil has an address. Their velocity is zero: contributions
#: to nodes outside the window are dropped.
PAD = 3

#: Nodes per axis: with more, velocities and masses of a single grid take more than 12 GiB.
LARGEST = 2**15


@tree.register
@dataclass(frozen=True)
class Grid:
    """A square window of G x G nodes, of which node (i, j) lies at ``origin + (i * h, j * h)``.

    Where the window lies in the world, its ``origin``, is an argument of each step, because a window may move.

    Attributes:
        resolution: G, the number of nodes along each axis.
        spacing: Distance h between nodes, m; ``None`` stands for ``1 / resolution``, a window 1 m wide.
        margin: Particles closer than this to the left or right end of the window, m, are not simulated. If no wall
            keeps particles away from the left end, choose ``h / 2``: within that distance of the end interpolation
            weights, and with them the masses of nodes, can become negative, which throws particles around.

    Raises:
        ValueError: ``resolution`` is not a whole number from 4 to 32,768, ``spacing`` is not a positive number, or
            ``margin`` is negative or not below half the window's width.
    """

    resolution: int = 128
    spacing: float | None = None
    margin: float = 1e-5

    def __post_init__(self) -> None:
        object.__setattr__(self, "resolution", checks.whole("resolution", self.resolution, 4, LARGEST))
        if self.spacing is not None:
            checks.number("spacing", self.spacing, above=0.0)
        checks.number("margin", self.margin, least=0.0)
        if not self.margin < (half := 0.5 * self.resolution * self.h):
            raise ValueError(f"margin must be below half the window's width, {half}, got {self.margin}")

    @property
    def h(self) -> float:
        """Distance between nodes, m."""
        return 1.0 / self.resolution if self.spacing is None else self.spacing

    @property
    def width(self) -> int:
        """Nodes per axis including the padding."""
        return self.resolution + 2 * PAD

    @property
    def extent(self) -> float:
        """Distance from the origin at which particles leave the window to the right, m; to the left: the margin."""
        return self.resolution * self.h - self.margin

    def nodes(self, origin: Tensor) -> Tensor:
        """Return the positions of all nodes, including the three rows of padding on each side of the window.

        Args:
            origin: (B, 2) lower left corner of the window in the world, m.

        Returns:
            (2, B, cells) x and y of the nodes, m, with ``cells = (resolution + 6)**2``; the index along y runs fastest.
            :meth:`torchmpm.Solver.boundary` gets velocities in this order.
        """
        along = torch.arange(-PAD, self.resolution + PAD).to(origin) * self.h
        x, y = torch.meshgrid(along, along, indexing="ij")
        return torch.stack((x.flatten(), y.flatten()))[:, None] + origin.T[..., None]

    def node_shift(self, origin: Tensor) -> Tensor:
        """Whole nodes between the world's origin and a window's at (B, 2), m, truncated towards zero, (B, 2) int64."""
        nodes = origin.detach() * (1.0 / self.h)
        nearest = nodes.round()
        whole = (nodes - nearest).abs() <= 4 * torch.finfo(nodes.dtype).eps * nearest.abs()  # but for rounding errors
        return torch.where(whole, nearest, nodes.trunc()).to(torch.int64)

    def contains(self, x: Tensor, origin_x: Tensor) -> Tensor:
        """Whether x (B, N), m, lies between the ends of the window from origin_x (B, 1), m; false for NaN."""
        offset = x - origin_x
        return (offset > self.margin) & (offset < self.extent)

    def takes_part(self, x: Tensor, y: Tensor, origin: Tensor) -> Tensor:
        """Which particles at (x, y), (B, N) each, m, move: those in the window at origin (B, 2), m."""
        height = (y - origin[:, 1:2]) * (1.0 / self.h)
        return self.contains(x, origin[:, 0:1]) & (height >= 0.0) & (height <= self.resolution)
