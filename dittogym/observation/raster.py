"""What the robot sees: occupancy and velocity of a half-window as a (3, 64, 64) uint8 image, row 0 at the top."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from dittogym.geometry import Box
from torchmpm.spline import quadratic_weights

#: Pixels of the image per axis, fine pixels per image pixel and axis, fine pixels of the whole window.
SIZE, BLOCK, RASTER = 64, 8, 1024
#: Pixels around the image that splats at its edge reach into.
FRAME = 3
#: Velocities are doubled and clipped to this before averaging.
CLIP = 10.0
#: Occupancy of a cell in which n full-size particles are expected: 1 - exp(-n / SATURATION). Thrown at random into the
#: 64 fine pixels of a cell they would give 63.5. Fitted so that the silhouette (occupancy >= 80 / 255) begins at
#: n = 25, where it differs least from the silhouette of the pixel raster.
SATURATION = 66.4


def crop_corner(centre: Tensor) -> tuple[Tensor, Tensor]:
    """First fine row and column of the crop around ``centre`` (B, 2), window coordinates in m; (B, 1) int64 each.

    Truncated towards zero and kept inside the window, like in the reference.
    """
    half = SIZE * BLOCK // 2
    middle = torch.trunc(RASTER * centre.detach()).to(torch.int64)
    column = (middle[:, 0:1] - half).clamp(0, RASTER - 2 * half)
    below = (middle[:, 1:2] - half).clamp(0, RASTER - 2 * half)
    return RASTER - below - 2 * half, column


class Background(NamedTuple):
    """What is drawn besides particles.

    Attributes:
        mask: (1 or B, 512, 512) bool, fine pixels of the crop that are set.
        share: (1 or B, 64, 64) share of an image pixel that is set.
    """

    mask: Tensor
    share: Tensor


class Sight(NamedTuple):
    """What an observation is made from.

    Attributes:
        position: (B, N, 2) window coordinates, m.
        velocity: (B, N, 2) doubled, clipped velocities; zero for silent particles.
        seen: (B, N) bool, particles that are drawn.
        silent: (N,) bool, particles that only the occupancy channel shows; ``None`` for none.
        row: First fine row of the crop, (B, 1).
        column: First fine column of the crop, (B, 1).
        background: What obstacles and goals set; ``None`` for nothing.
    """

    position: Tensor
    velocity: Tensor
    seen: Tensor
    silent: Tensor | None
    row: Tensor
    column: Tensor
    background: Background | None


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
    share = mask.view(-1, SIZE, BLOCK, SIZE, BLOCK).to(origin.dtype).mean((2, 4))
    return Background(mask, share)


@functools.lru_cache(maxsize=64)
@torch.inference_mode(False)  # what is kept must serve gradients later
def draw_boxes_once(
    boxes: tuple[Box, ...], origin: tuple[float, float], row: int, column: int, dtype: torch.dtype, device: torch.device
) -> Background | None:
    """What :func:`draw_boxes` returns where neither window nor crop moves, kept for the next picture."""
    place = torch.tensor([origin], dtype=dtype, device=device)
    return draw_boxes(boxes, place, *(torch.tensor([[first]], device=device) for first in (row, column)))


def _between(value: Tensor, low: float, high: float, closed: bool) -> Tensor:
    return (value >= low) & (value <= high) if closed else (value > low) & (value < high)


def pixel_means(sight: Sight) -> Tensor:
    """The reference's raster: a fine pixel is set by any particle in it and has the velocity of the last one.

    Returns:
        (B, 3, 64, 64) means over image pixels of occupancy and both velocities.
    """
    position, velocity, seen, silent, row, column, drawn = sight
    batch, count = seen.shape
    width = SIZE * BLOCK
    r = torch.trunc((1.0 - position[..., 1]) * float(RASTER)).to(torch.int64) - row
    c = torch.trunc(position[..., 0] * float(RASTER)).to(torch.int64) - column
    seen = seen & (position[..., 1] > 0) & (r >= 0) & (r < width) & (c >= 0) & (c < width)
    r, c = torch.where(seen, r, 0), torch.where(seen, c, 0)
    fine = r * width + c
    # Silent particles leave the velocity of a pixel to any other particle in it.
    rank = torch.arange(count, device=r.device)
    rank = rank if silent is None else rank + torch.where(silent, 0, count)
    order = torch.where(seen, rank, -1)
    last = torch.full((batch, width * width), -1, dtype=torch.int64, device=r.device)
    last = last.scatter_reduce(1, fine, order, "amax")
    wins = seen & (last.gather(1, fine) == order)
    new = wins if drawn is None else wins & ~drawn.mask.flatten(1).expand(batch, -1).gather(1, fine)
    values = torch.stack((new.to(velocity.dtype), *(wins * v for v in velocity.unbind(-1))))
    coarse = (r // BLOCK) * SIZE + c // BLOCK
    sums = torch.zeros(3, batch, SIZE * SIZE, dtype=velocity.dtype, device=r.device)
    sums = sums.scatter_add(2, coarse.expand(3, -1, -1), values).view(3, batch, SIZE, SIZE)
    means = sums.transpose(0, 1) / BLOCK**2
    if drawn is not None:
        means[:, 0] += drawn.share
    return means


def splat_means(sight: Sight, shares: Tensor) -> Tensor:
    """What the reference's raster of full-size bodies would show on average, from fewer particles.

    Particles are spread over image pixels by quadratic B-splines, which gives the number n of full-size particles to
    expect in a pixel; the share of its fine pixels that they hit is ``1 - exp(-n / SATURATION)``.

    Args:
        sight: What is there.
        shares: (N,) full-size particles that each particle stands for.

    Returns:
        (B, 3, 64, 64) means over image pixels of occupancy and both velocities.
    """
    position, velocity, seen, silent, row, column, drawn = sight
    batch, width = len(seen), SIZE + 2 * FRAME
    u = position[..., 0] * (RASTER / BLOCK) - column / BLOCK - 0.5
    w = (1.0 - position[..., 1]) * (RASTER / BLOCK) - row / BLOCK - 0.5
    middle, reach = 0.5 * SIZE, 0.5 * SIZE + 1.5
    near = seen & ((u - middle).abs() < reach) & ((w - middle).abs() < reach)
    u, w = torch.where(near, u, 0.0), torch.where(near, w, 0.0)
    base_u, base_w = torch.floor(u - 0.5), torch.floor(w - 0.5)
    across = quadratic_weights(u - base_u) * (near * shares)[:, None]
    weight = (quadratic_weights(w - base_w)[:, :, None] * across[:, None]).flatten(1, 2)
    first = ((base_w + FRAME) * width + base_u + FRAME).to(torch.int64)
    offset = torch.arange(3, device=u.device)
    ids = (first[:, None] + (offset[:, None] * width + offset).view(9, 1)).flatten(1)
    moving = weight if silent is None else weight * ~silent
    rows = [weight, *(moving * v[:, None] for v in velocity.unbind(-1))]
    rows += [] if silent is None else [moving]
    sums = torch.zeros(len(rows), batch, width**2, dtype=velocity.dtype, device=u.device)
    sums = sums.scatter_add(2, ids.expand(len(rows), -1, -1), torch.stack(rows).flatten(2))
    sums = sums.view(-1, batch, width, width)[..., FRAME:-FRAME, FRAME:-FRAME]
    expected, heard = sums[0], sums[0 if silent is None else 3]
    free = 1.0 if drawn is None else 1.0 - drawn.share
    hit = -torch.expm1(-heard / SATURATION)
    per_particle = torch.where(heard > 0, hit / torch.where(heard > 0, heard, 1.0), 0.0)
    occupancy = 1.0 - free * torch.exp(-expected / SATURATION)
    return torch.stack((occupancy, sums[1] * per_particle, sums[2] * per_particle), dim=1)


def coded(means: Tensor) -> Tensor:
    """Bring block means (B, 3, 64, 64) to the units of the image: occupancy 0 to 255, zero velocity at 132."""
    occupancy = 255.0 * means[:, :1]
    velocity = 10.0 * (255.0 * (means[:, 1:] + CLIP) / (2 * CLIP) - 127.0) + 127.0
    return torch.cat((occupancy, velocity), dim=1).clamp(0.0, 255.0)


def quantise(means: Tensor) -> Tensor:
    """Block means (B, 3, 64, 64) as the uint8 image: :func:`coded`, truncated."""
    return coded(means).to(torch.uint8)
