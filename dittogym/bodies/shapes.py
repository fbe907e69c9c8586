"""Where the particles of a body start: discs, boxes, lattices and pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, runtime_checkable

import numpy as np

from torchmpm import checks, sampling
from torchmpm.sampling import Points


@runtime_checkable
class Shape(Protocol):
    """Interface of a shape: any object with these members says where the particles of a body start."""

    @property
    def draws(self) -> int:
        """How many uniform numbers the reference implementation draws for a particle; 0 if all starts are alike.

        With 2, these are the two coordinates. With 4, they are the magnitudes and the signs of two coordinates that are
        counted from the centre.
        """

    @property
    def corner(self) -> tuple[float, float]:
        """Lower left corner of the bounding box in the world, m."""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the bounding box, m."""

    @property
    def area(self) -> float:
        """Area, m^2."""

    def positions(self, numbers: Points) -> Points:
        """Return the positions of N particles.

        Args:
            numbers: (N, 2) numbers from 0 to 1; a lattice uses N alone.

        Returns:
            (N, 2) positions in the world, m, within the bounding box.
        """


@dataclass(frozen=True)
class Disc:
    """A disc with the density of the reference implementation, see :func:`torchmpm.sampling.chord_disc`.

    Attributes:
        corner: Lower left corner (x, y) of the bounding square in the world, m.
        diameter: Diameter, m.

    Raises:
        ValueError: ``corner`` is not two numbers, or ``diameter`` is not positive.
    """

    corner: tuple[float, float]
    diameter: float
    draws: ClassVar[int] = 4

    def __post_init__(self) -> None:
        checks.pair("corner", self.corner)
        checks.number("diameter", self.diameter, above=0.0)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the bounding box, m."""
        return self.diameter, self.diameter

    @property
    def area(self) -> float:
        """Area, m^2."""
        return 0.25 * math.pi * self.diameter**2

    def positions(self, numbers: Points) -> Points:
        """Return positions in the world, (N, 2), m, from ``numbers`` (N, 2) from 0 to 1."""
        radius = 0.5 * self.diameter
        return sampling.chord_disc(numbers, (self.corner[0] + radius, self.corner[1] + radius), radius)


@dataclass(frozen=True)
class Rectangle:
    """A box of uniform density.

    Attributes:
        corner: Lower left corner (x, y) in the world, m.
        size: Width and height, m.
        draws: 2 or 4, see :attr:`Shape.draws`.

    Raises:
        ValueError: ``corner`` is not two numbers, ``size`` is not two positive numbers, or ``draws`` is another number.
    """

    allowed_draws: ClassVar[tuple[int, ...]] = (2, 4)

    corner: tuple[float, float]
    size: tuple[float, float]
    draws: int = field(default=4, kw_only=True)

    def __post_init__(self) -> None:
        checks.pair("corner", self.corner)
        checks.pair("size", self.size, above=0.0)
        if self.draws not in self.allowed_draws:
            raise ValueError(f"draws must be one of {self.allowed_draws}, got {self.draws!r}")

    @property
    def area(self) -> float:
        """Area, m^2."""
        return self.size[0] * self.size[1]

    def positions(self, numbers: Points) -> Points:
        """Return positions in the world, (N, 2), m, from ``numbers`` (N, 2) from 0 to 1."""
        return sampling.box(numbers, self.corner, self.size)


@dataclass(frozen=True)
class Lattice(Rectangle):
    """A box with evenly spaced particles, the same with every seed.

    They lie in rows from the bottom up, whose numbers of particles differ by at most one.

    Attributes:
        corner: Lower left corner (x, y) in the world, m.
        size: Width and height, m.
        draws: Always 0, see :attr:`Shape.draws`.
    """

    allowed_draws: ClassVar[tuple[int, ...]] = (0,)
    draws: int = field(default=0, kw_only=True)

    def positions(self, numbers: Points) -> Points:
        """Return positions in the world, (N, 2), m; of ``numbers`` (N, 2) only N matters."""
        count = len(numbers)
        rows = max(1, round(math.sqrt(count * self.size[1] / self.size[0])))
        rank = np.arange(count)
        row = rank * rows // count
        first = -(-row * count // rows)  # of the row: the smallest rank that falls into it
        across = (rank - first + 0.5) / np.bincount(row, minlength=rows)[row]
        return sampling.box(np.stack((across, (row + 0.5) / rows), axis=1), self.corner, self.size)


@dataclass(frozen=True, eq=False)
class Figure:
    """The true pixels of a mask, with uniform density.

    Attributes:
        mask: (rows, columns) bool, row 0 at the top, without empty rows or columns at the edges.
        corner: Lower left corner (x, y) in the world, m.
        pixel: Side of a pixel, m.

    Raises:
        ValueError: The mask has no pixel set, or none in an outer row or column, or a number is out of range.
    """

    mask: np.ndarray
    corner: tuple[float, float]
    pixel: float
    draws: ClassVar[int] = 2

    def __post_init__(self) -> None:
        checks.pair("corner", self.corner)
        checks.number("pixel", self.pixel, above=0.0)
        mask = self.mask
        if not isinstance(mask, np.ndarray) or mask.ndim != 2 or mask.dtype != bool or not mask.any():
            found = f"{getattr(mask, 'dtype', type(mask).__name__)} of shape {np.shape(mask)}"
            raise ValueError(f"mask must be an array (rows, columns) of bool with a pixel set, got {found}")
        if not all(edge.any() for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1])):
            found = f"{mask.shape[0]} rows and {mask.shape[1]} columns, of which an outer one is empty"
            raise ValueError(f"mask must have pixels in its first and last row and column, got {found}")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the bounding box, m."""
        return self.mask.shape[1] * self.pixel, self.mask.shape[0] * self.pixel

    @property
    def area(self) -> float:
        """Area, m^2."""
        return float(self.mask.sum()) * self.pixel**2

    def positions(self, numbers: Points) -> Points:
        """Return positions in the world, (N, 2), m, from ``numbers`` (N, 2) from 0 to 1."""
        return sampling.image(numbers, self.mask, self.corner, self.size)
