"""Rasters of a half-window: mean occupancy and velocity of image pixels (3, 64, 64), row 0 at the top.

Crop and background also as smooth functions, see ``docs/concepts/gradients.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dittogym.geometry import Box
from dittogym.observation.image import BLOCK, RASTER, SATURATION, SIZE
from torchmpm.transfer import quadratic_weights

#: Pixels around the image that splats at its edge reach into.
FRAME = 3
#: Fine pixels by which truncation shifts a moving crop, and the rule of :func:`draw_boxes` a box, on average.
HALF = 0.5


def crop_corner(centre: Tensor) -> tuple[Tensor, Tensor]:
    """First fine row and column of the crop around ``centre`` (B, 2), window coordinates in m; (B, 1) int64 each.

    Truncated towards zero and kept inside the window, like in the reference.
    """
    half = SIZE * BLOCK // 2
    middle = torch.trunc(RASTER * centre.detach()).to(torch.int64)
    column = (middle[:, 0:1] - half).clamp(0, RASTER - 2 * half)
    below = (middle[:, 1:2] - half).clamp(0, RASTER - 2 * half)
    return RASTER - below - 2 * half, column


def smooth_crop_corner(centre: Tensor, follows: tuple[bool, bool]) -> tuple[Tensor, Tensor]:
    """First fine row and column (B, 1) of a crop, not truncated along axes on which it ``follows`` the robot."""
    half = SIZE * BLOCK // 2
    row, column = (corner.to(centre.dtype) for corner in crop_corner(centre))
    first = (RASTER * centre - HALF - half).clamp(0.0, RASTER - 2.0 * half)
    if follows[0]:
        column = first[:, 0:1]
    if follows[1]:
        row = RASTER - 2 * half - first[:, 1:2]
    return row, column


class Background(NamedTuple):
    """What is drawn besides particles."""

    mask: Tensor  # (1 or B, 512, 512) bool, fine pixels of the crop that are set
    fraction: Tensor  # (1 or B, 64, 64) fraction of an image pixel that is set


class RasterInput(NamedTuple):
    """What an image is made from."""

    position: Tensor  # (B, N, 2) window coordinates, m
    velocity: Tensor  # (B, N, 2) doubled, clipped velocities; zero where hidden
    weight: Tensor  # (N,) full-size particles that each particle stands for
    visible: Tensor  # (B, N) bool, particles that are drawn
    hidden_velocity: Tensor | None  # (N,) bool, particles that only the occupancy channel shows; None if there are none
    row: Tensor  # First fine row of the crop, (B, 1)
    column: Tensor  # First fine column of the crop, (B, 1)
    background: Background | None = None  # What obstacles and goals set; None for nothing


def draw_boxes(boxes: Sequence[Box], origin: Tensor, row: Tensor, column: Tensor) -> Background | None:
    """Draw boxes for windows at ``origin`` (B, 2) and crops that begin at ``row`` and ``column`` (B, 1).

    A pixel belongs to a box if its left edge and its upper edge lie in it.
    """
    if not boxes:
        return None
    pixels = torch.arange(SIZE * BLOCK, device=origin.device)
    x = (column + pixels) / RASTER + origin[:, 0:1]
    y = (RASTER - row - pixels) / RASTER + origin[:, 1:2]
    across = torch.stack([_between(x, box.left, box.right, box.closed) for box in boxes], dim=1)
    along = torch.stack([_between(y, box.bottom, box.top, box.closed) for box in boxes], dim=2)
    mask = along.float() @ across.float() > 0
    fraction = mask.view(len(mask), SIZE, BLOCK, SIZE, BLOCK).to(origin.dtype).mean((2, 4))
    return Background(mask, fraction)


def _between(value: Tensor, low: float, high: float, closed: bool) -> Tensor:
    return (value >= low) & (value <= high) if closed else (value > low) & (value < high)


def box_fraction(boxes: Sequence[Box], origin: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Fraction of each image pixel that boxes cover, (B, 64, 64), for a window at ``origin`` (B, 2), m.

    Boxes may touch; where they overlap within a pixel that they do not fill, the overlap counts twice.
    """
    pixel = torch.arange(SIZE, device=origin.device, dtype=origin.dtype)
    width = BLOCK / RASTER
    left = (column + BLOCK * pixel - HALF) / RASTER + origin[:, 0:1]
    bottom = (RASTER - row - BLOCK * (pixel + 1) + HALF) / RASTER + origin[:, 1:2]
    fraction = torch.zeros_like(bottom[:, :, None])
    for box in boxes:
        along, across = _overlap(bottom, width, box.bottom, box.top), _overlap(left, width, box.left, box.right)
        fraction = fraction + along[:, :, None] * across[:, None]
    return fraction.clamp_max(1.0)


def _overlap(start: Tensor, width: float, low: float, high: float) -> Tensor:
    """Fraction of the intervals of a ``width`` from ``start`` on that lies between ``low`` and ``high``."""
    return ((start + width).clamp_max(high) - start.clamp_min(low)).clamp_min(0.0) / width


def pixel_means(shown: RasterInput) -> Tensor:
    """The reference's raster, (B, 3, 64, 64): a particle sets its fine pixel, the last one in it gives its velocity."""
    position, velocity, _, visible, hidden, row, column, background = shown
    batch, count = visible.shape
    width = SIZE * BLOCK
    r = torch.trunc((1.0 - position[..., 1]) * float(RASTER)).to(torch.int64) - row
    c = torch.trunc(position[..., 0] * float(RASTER)).to(torch.int64) - column
    visible = visible & (position[..., 1] > 0) & (r >= 0) & (r < width) & (c >= 0) & (c < width)
    r, c = torch.where(visible, r, 0), torch.where(visible, c, 0)
    fine = r * width + c
    # Particles whose velocity is hidden leave the velocity of a pixel to any other particle in it.
    rank = torch.arange(count, device=r.device)
    rank = rank if hidden is None else rank + torch.where(hidden, 0, count)
    order = torch.where(visible, rank, -1)
    last = torch.full((batch, width * width), -1, dtype=torch.int64, device=r.device)
    last = last.scatter_reduce(1, fine, order, "amax")
    wins = visible & (last.gather(1, fine) == order)
    new = wins  # the background has not set its pixel
    if background is not None:
        new = wins & ~background.mask.flatten(1).expand(batch, -1).gather(1, fine)
    values = torch.stack((new.to(velocity.dtype), *(wins * v for v in velocity.unbind(-1))))
    coarse = (r // BLOCK) * SIZE + c // BLOCK
    sums = torch.zeros(3, batch, SIZE * SIZE, dtype=velocity.dtype, device=r.device)
    sums = sums.scatter_add(2, coarse.expand(3, -1, -1), values).view(3, batch, SIZE, SIZE)
    means = sums.transpose(0, 1) / BLOCK**2
    if background is not None:
        means[:, 0] += background.fraction
    return means


def splat_means(shown: RasterInput) -> Tensor:
    """What the reference's raster of full-size bodies would show on average, (B, 3, 64, 64), from fewer particles.

    Quadratic B-splines give the number n of full-size particles to expect in a pixel, which hit the fraction
    ``1 - exp(-n / SATURATION)`` of its fine pixels.
    """
    hidden, background = shown.hidden_velocity, shown.background
    weight, ids = _splat_weights(shown)
    moving = weight if hidden is None else weight * ~hidden
    rows = [weight, *(moving * v[:, None] for v in shown.velocity.unbind(-1))]
    rows += [] if hidden is None else [moving]
    batch, width = len(weight), SIZE + 2 * FRAME
    sums = torch.zeros(len(rows), batch, width**2, dtype=weight.dtype, device=weight.device)
    sums = sums.scatter_add(2, ids.expand(len(rows), -1, -1), torch.stack(rows).flatten(2))
    sums = sums.view(len(rows), batch, width, width)[..., FRAME:-FRAME, FRAME:-FRAME]
    expected, expected_moving = sums[0], sums[0 if hidden is None else 3]
    free = 1.0 if background is None else 1.0 - background.fraction
    hit = -torch.expm1(-expected_moving / SATURATION)
    some = expected_moving > 0
    per_particle = torch.where(some, hit / torch.where(some, expected_moving, 1.0), 0.0)
    occupancy = 1.0 - free * torch.exp(-expected / SATURATION)
    return torch.stack((occupancy, sums[1] * per_particle, sums[2] * per_particle), dim=1)


def _splat_weights(shown: RasterInput) -> tuple[Tensor, Tensor]:
    """Weights (B, 9, N) of the pixels around each particle, and their indices (B, 9 N) in the framed image."""
    position, width = shown.position, SIZE + 2 * FRAME
    u = position[..., 0] * (RASTER / BLOCK) - shown.column / BLOCK - 0.5
    w = (1.0 - position[..., 1]) * (RASTER / BLOCK) - shown.row / BLOCK - 0.5
    middle, reach = 0.5 * SIZE, 0.5 * SIZE + 1.5
    near = shown.visible & ((u - middle).abs() < reach) & ((w - middle).abs() < reach)
    u, w = torch.where(near, u, 0.0), torch.where(near, w, 0.0)
    base_u, base_w = torch.floor(u - 0.5), torch.floor(w - 0.5)
    across = quadratic_weights(u - base_u) * (near * shown.weight)[:, None]
    weight = (quadratic_weights(w - base_w)[:, :, None] * across[:, None]).flatten(1, 2)
    first = ((base_w + FRAME) * width + base_u + FRAME).to(torch.int64)
    offset = torch.arange(3, device=u.device)
    ids = (first[:, None] + (offset[:, None] * width + offset).view(9, 1)).flatten(1)
    return weight, ids
