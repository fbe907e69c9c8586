"""Particle positions in simple shapes, from numbers that the caller supplies.

Each shape is a map of the unit square: its ``numbers`` are ``generator.random((count, 2))`` of a NumPy generator for
random particles, or ``sobol(count, seed)`` for evenly spread ones. No function here reads or changes a global
generator. Positions are NumPy arrays of float64; ``torch.as_tensor`` makes a tensor of them, for
:meth:`torchmpm.ParticleState.at_rest`.
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
    """Return evenly spread points of the unit square, with far fewer clumps and holes than random ones.

    They are the first points of a scrambled Sobol sequence (Sobol, 1967; Owen, 1998), see
    ``torch.quasirandom.SobolEngine``.

    Args:
        count: N, from 1 to 2**30.
        seed: Seed of the scrambling, a whole number from 0 to 2**63 - 1.

    Returns:
        (N, 2) numbers from 0 to 1.

    Raises:
        ValueError: ``count`` or ``seed`` is not a whole number in its range.
        RuntimeError: Under a transform of ``torch.func`` or a trace of ``make_fx``, which have no such random numbers.

    Examples:
        >>> import torch, torchmpm
        >>> numbers = torchmpm.sampling.sobol(1000, seed=0)
        >>> points = torchmpm.sampling.disc(numbers, centre=(0.5, 0.5), radius=0.1)
        >>> state = torchmpm.ParticleState.at_rest(torch.as_tensor(points, dtype=torch.float32))
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
    """Return positions in a filled axis-aligned box, of uniform density.

    Args:
        numbers: (N, 2) numbers from 0 to 1, one row for each particle.
        corner: Lower left corner (x, y), m.
        size: Width and height, m.

    Returns:
        (N, 2) positions, m.

    Raises:
        ValueError: ``numbers`` is not such an array, ``corner`` not two numbers, or ``size`` not two positive numbers.
    """
    checks.points("numbers", numbers)
    checks.pair("corner", corner)
    checks.pair("size", size, above=0.0)
    return np.asarray(corner) + numbers * np.asarray(size)


def disc(numbers: Points, centre: tuple[float, float], radius: float) -> Points:
    """Return positions in a filled disc of uniform density.

    Args:
        numbers: (N, 2) numbers from 0 to 1, one row for each particle.
        centre: Centre (x, y), m.
        radius: Radius, m.

    Returns:
        (N, 2) positions, m.

    Raises:
        ValueError: ``numbers`` is not such an array, ``centre`` not two numbers, or ``radius`` not positive.
    """
    _check_round(numbers, centre, radius)
    distance, angle = radius * np.sqrt(numbers[:, 0]), 2.0 * math.pi * numbers[:, 1]
    return np.asarray(centre) + np.stack((distance * np.cos(angle), distance * np.sin(angle)), axis=1)


def chord_disc(numbers: Points, centre: tuple[float, float], radius: float) -> Points:
    """Return positions in a disc that are denser to the left and to the right, as in DittoGym's round robots.

    They are uniform in x over the width of the disc and, at each x, in y over the chord (Huang et al., 2024). With
    equal particle masses this also makes robots stiffer at both ends.

    Args:
        numbers: (N, 2) numbers from 0 to 1, one row for each particle.
        centre: Centre (x, y), m.
        radius: Radius, m.

    Returns:
        (N, 2) positions, m.

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
    """Return the centres of the cells of a box, row by row from the bottom up.

    Args:
        cells: Number of cells in x and in y; their product N is at most 2**30.
        corner: Lower left corner (x, y) of the box, m.
        size: Width and height of the box, m.

    Returns:
        (N, 2) positions, m.

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
    """Return positions that fill the pixels of a mask with uniform density.

    The first of a particle's two numbers determines its x: the column of pixels, chosen in proportion to their number,
    and the place within the column's width. The second number determines its y among the pixels of that column. So
    evenly spread numbers give evenly spread particles.

    Args:
        numbers: (N, 2) numbers from 0 to 1, one row for each particle.
        mask: (H, W) bool or whole numbers, true or not zero where particles go; row 0 is at the top.
        corner: Lower left corner (x, y) of the whole image, m.
        size: Width and height of the whole image, m.

    Returns:
        (N, 2) positions, m.

    Raises:
        ValueError: ``mask`` has no pixel set or is another kind of array, or another argument is not as in :func:`box`.
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
