"""Particle positions in simple shapes, from numbers that the caller supplies.

Each shape is a map of the unit square: give it ``generator.random((count, 2))`` of NumPy for random particles,
``sobol(count, seed)`` for evenly spread ones. No function here touches a global generator.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from torchmpm import checks
from torchmpm.native.library import leave_parent_threads
from torchmpm.tree import transforming

Points = NDArray[np.float64]
#: Most points that are made at once; a Sobol sequence of torch has no more.
LARGEST = 2**30


def sobol(count: int, seed: int) -> Points:
    """Points (N, 2) of a scrambled Sobol sequence in the unit square: far fewer clumps and holes than random ones.

    Args:
        count: N, from 1 to 2**30.
        seed: Seed of the scrambling, a whole number from 0 to 2**63 - 1.

    Raises:
        ValueError: ``count`` or ``seed`` is not a whole number in its range.
        RuntimeError: Under a transform of ``torch.func`` or a trace of ``make_fx``, which have no such random numbers.
    """
    checks.whole("seed", seed, 0, 2**63 - 1)
    if transforming():
        raise RuntimeError("sobol must not be called under a transform of torch.func or a trace: draw the points first")
    checks.whole("count", count, 1, LARGEST)
    leave_parent_threads()
    engine = torch.quasirandom.SobolEngine(2, scramble=True, seed=seed)
    points = engine.draw(count, dtype=torch.float64).numpy()
    points[0] = points[0].astype(np.float32)  # as the engine rounds it unless torch's default is double precision
    return points


def box(numbers: Points, corner: tuple[float, float], size: tuple[float, float]) -> Points:
    """Positions (N, 2), m, in a filled axis-aligned box.

    Args:
        numbers: (N, 2) points of the unit square.
        corner: Lower left corner, m.
        size: Width and height, m.

    Raises:
        ValueError: ``numbers`` is not such an array, ``corner`` not two numbers, or ``size`` not two positive numbers.
    """
    checks.points("numbers", numbers)
    checks.pair("corner", corner)
    checks.pair("size", size, above=0.0)
    return np.asarray(corner) + numbers * np.asarray(size)


def disc(numbers: Points, centre: tuple[float, float], radius: float) -> Points:
    """Positions (N, 2), m, in a filled disc of uniform density.

    Args:
        numbers: (N, 2) points of the unit square.
        centre: Centre, m.
        radius: Radius, m.

    Raises:
        ValueError: ``numbers`` is not such an array, ``centre`` not two numbers, or ``radius`` not positive.
    """
    _check_round(numbers, centre, radius)
    distance, angle = radius * np.sqrt(numbers[:, 0]), 2.0 * math.pi * numbers[:, 1]
    return np.asarray(centre) + np.stack((distance * np.cos(angle), distance * np.sin(angle)), axis=1)


def chord_disc(numbers: Points, centre: tuple[float, float], radius: float) -> Points:
    """Positions (N, 2), m, uniform over the width of a disc and, at each x, over the chord: denser to left and right.

    The distribution of DittoGym's round robots; with constant particle mass it also makes them stiffer at both ends.

    Args:
        numbers: (N, 2) points of the unit square.
        centre: Centre, m.
        radius: Radius, m.

    Raises:
        ValueError: ``numbers`` is not such an array, ``centre`` not two numbers, or ``radius`` not positive.
    """
    _check_round(numbers, centre, radius)
    across, along = 2.0 * numbers[:, 0] - 1.0, 2.0 * numbers[:, 1] - 1.0
    chord = np.sqrt(radius**2 - (radius * across) ** 2)
    return np.stack((centre[0] + radius * across, centre[1] + along * chord), axis=1)


def _check_round(numbers: Points, centre: tuple[float, float], radius: float) -> None:
    checks.points("numbers", numbers)
    checks.pair("centre", centre)
    checks.number("radius", radius, above=0.0)


def lattice(cells: tuple[int, int], corner: tuple[float, float], size: tuple[float, float]) -> Points:
    """Positions (N, 2), m, in the middle of the N cells of a box; rows from the bottom up.

    Args:
        cells: Number of cells in x and y, N at most 2**30.
        corner: Lower left corner, m.
        size: Width and height, m.

    Raises:
        ValueError: ``cells`` is not two whole numbers above 0 or too many, ``corner`` not two numbers, or ``size`` not
            two positive numbers.
    """
    checks.pair("cells", cells)
    for axis, count in zip("xy", cells, strict=True):
        checks.whole(f"cells in {axis}", count, 1)
    checks.whole("number of cells", math.prod(cells), 1, LARGEST)
    columns, rows = np.meshgrid((np.arange(cells[0]) + 0.5) / cells[0], (np.arange(cells[1]) + 0.5) / cells[1])
    return box(np.stack((columns.ravel(), rows.ravel()), axis=1), corner, size)


def image(numbers: Points, mask: NDArray[np.bool_], corner: tuple[float, float], size: tuple[float, float]) -> Points:
    """Positions (N, 2), m, that fill the pixels of a mask with uniform density.

    The first number chooses the column by its share of the pixels and the place within it, the second the place in the
    column's pixels, so that evenly spread numbers give evenly spread particles.

    Args:
        numbers: (N, 2) points of the unit square.
        mask: (H, W), row 0 at the top.
        corner: Lower left corner of the whole image, m.
        size: Width and height of the whole image, m.

    Raises:
        ValueError: The mask has no pixel set or another shape, or another argument is not as in :func:`box`.
    """
    checks.points("numbers", numbers)
    if not isinstance(mask, np.ndarray) or mask.ndim != 2 or mask.dtype.kind not in "biu":
        kind = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
        raise ValueError(f"mask must be an array (H, W) of bool, got {kind} of shape {np.shape(mask)}")
    pixels = np.flipud(mask.astype(bool)).T  # (column, row from below)
    counts = pixels.sum(1)
    if not counts.any():
        raise ValueError("mask must have at least one pixel set, got none")
    edges = np.concatenate(([0], np.cumsum(counts)))
    # A one is the end of the last pixel, not the start of another.
    place = np.minimum(numbers[:, 0] * edges[-1], np.nextafter(edges[-1], 0.0))
    column = np.searchsorted(edges, place, side="right") - 1
    depth = np.minimum(numbers[:, 1] * counts[column], np.nextafter(counts[column], 0.0))
    rank = edges[column] + depth.astype(np.int64)
    row = np.nonzero(pixels)[1][rank]
    points = np.stack((column + (place - edges[column]) / counts[column], row + depth % 1.0), axis=1)
    return box(points / pixels.shape, corner, size)
