"""Stencils, and the movement of numbers between particles and nodes, in kernels.

Addresses of nodes count on the padded grid of :data:`torchmpm.grid.PAD` extra rows, (i + PAD) width + j + PAD.
"""

import triton
import triton.language as tl

from torchmpm.grid import PAD as _PAD
from torchmpm.native.cuda.material import EXTENT, INVERSE_H, MARGIN

PAD = tl.constexpr(_PAD)
#: Larger than any node, in a box that holds none.
NOWHERE = tl.constexpr(2**29)
#: Sizes that kernels take; one compiled kernel serves all of them.
SIZES = (
    *("particles", "stride", "first", "count", "blocks", "column", "columns", "values_batch"),
    *("resolution", "width", "programs", "cells", "rule_count"),
)


@triton.jit
def truncated(value):
    """Towards zero."""
    return tl.where(value < 0, tl.ceil(value), tl.floor(value))


@triton.jit
def locate_axis(u, on, resolution):
    """First node and distance from it in cells, 0 for particles that take no part."""
    base = truncated(u - 0.5)
    f = tl.where(on, u - base, 0.0)
    # Clamped before the conversion, which is undefined for large numbers; NaN goes to the low end.
    base = tl.where(base > -PAD, base, -PAD)
    base = tl.where(base < resolution, base, resolution)
    return base.to(tl.int32) + PAD, f


@triton.jit
def locate(x, y, origin, valid, constants, resolution):
    """Whether particles take part, their first nodes (i, j), and their distances from these."""
    inverse_h = tl.load(constants + INVERSE_H)
    offset = x - tl.load(origin)
    up = (y - tl.load(origin + 1)) * inverse_h
    on = valid & (offset > tl.load(constants + MARGIN)) & (offset < tl.load(constants + EXTENT))
    on = on & (up >= 0.0) & (up <= resolution)  # false for NaN
    i, fx = locate_axis(offset * inverse_h, on, resolution)
    j, fy = locate_axis(up, on, resolution)
    return on, i, j, fx, fy


@triton.jit
def weight(f, k: tl.constexpr):
    """Weight of node k of three along an axis."""
    if k == 0:
        w = 0.5 * (1.5 - f) * (1.5 - f)
    elif k == 1:
        w = 0.75 - (f - 1.0) * (f - 1.0)
    else:
        w = 0.5 * (f - 0.5) * (f - 0.5)
    return w


@triton.jit
def weight_slope(f, k: tl.constexpr):
    """Derivative of :func:`weight` in f."""
    if k == 0:
        slope = f - 1.5
    elif k == 1:
        slope = 2.0 - 2.0 * f
    else:
        slope = f - 0.5
    return slope


@triton.jit
def gather(nodes, first, width, fx, fy, on, SIZE: tl.constexpr):
    """Interpolate the two numbers at the beginning of each node of ``SIZE``, and their moments in cells.

    Returns:
        sum w n for both, then sum w n (offset - f) of the first in x and y, then of the second.
    """
    vx, vy = tl.zeros_like(fx), tl.zeros_like(fx)
    xx, xy, yx, yy = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
    for p in tl.static_range(3):
        across_x, across_y, tilt_x, tilt_y = tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx), tl.zeros_like(fx)
        for q in tl.static_range(3):
            at = nodes + SIZE * (first + p * width + q)
            nx, ny = tl.load(at, on, other=0.0), tl.load(at + 1, on, other=0.0)
            w = weight(fy, q)
            t = w * (q - fy)
            across_x += w * nx
            across_y += w * ny
            tilt_x += t * nx
            tilt_y += t * ny
        w = weight(fx, p)
        t = w * (p - fx)
        vx += w * across_x
        vy += w * across_y
        xx += t * across_x
        xy += w * tilt_x
        yx += t * across_y
        yy += w * tilt_y
    return vx, vy, xx, xy, yx, yy


@triton.jit
def field_at(field, i, j, p: tl.constexpr, q: tl.constexpr, on, resolution):
    """Address of node (p, q) of the stencil in the actuation field (2, G, G), and whether it exists."""
    row, column = i + (p - PAD), j + (q - PAD)
    exists = on & (row >= 0) & (row < resolution) & (column >= 0) & (column < resolution)
    return field + row * resolution + column, exists


@triton.jit
def actuation_at(field, element, i, j, fx, fy, on, resolution, MUSCLE: tl.constexpr):
    """Muscle actuation of particles from the field (B, 2, G, G); zero where they have no muscles."""
    ax, ay = tl.zeros_like(fx), tl.zeros_like(fx)
    if MUSCLE:
        field += 2 * resolution * resolution * element
        for p in tl.static_range(3):
            for q in tl.static_range(3):
                at, exists = field_at(field, i, j, p, q, on, resolution)
                w = weight(fx, p) * weight(fy, q)
                ax += w * tl.load(at, exists, other=0.0)
                ay += w * tl.load(at + resolution * resolution, exists, other=0.0)
    return ax, ay


@triton.jit
def include(box, i, j, on):
    """Widen a box (first i, first j, minus last i, minus last j; of first nodes) by those of particles."""
    tl.atomic_min(box, tl.min(tl.where(on, i, NOWHERE), axis=0), sem="relaxed")
    tl.atomic_min(box + 1, tl.min(tl.where(on, j, NOWHERE), axis=0), sem="relaxed")
    tl.atomic_min(box + 2, tl.min(tl.where(on, -i, NOWHERE), axis=0), sem="relaxed")
    tl.atomic_min(box + 3, tl.min(tl.where(on, -j, NOWHERE), axis=0), sem="relaxed")


@triton.jit
def scatter(nodes, first, width, fx, fy, on, vx, vy, xx, xy, yx, yy, mass, MASS: tl.constexpr, SIZE: tl.constexpr):
    """Add ``w (v + A d)`` to two numbers of each node, with d = offset - f in cells, and ``w m`` to a third."""
    for p in tl.static_range(3):
        dx = p - fx
        for q in tl.static_range(3):
            dy = q - fy
            w = weight(fx, p) * weight(fy, q)
            at = nodes + SIZE * (first + p * width + q)
            tl.atomic_add(at, w * (vx + xx * dx + xy * dy), on, sem="relaxed")
            tl.atomic_add(at + 1, w * (vy + yx * dx + yy * dy), on, sem="relaxed")
            if MASS:
                tl.atomic_add(at + 2, w * mass, on, sem="relaxed")
