"""What the robot sees: occupancy and velocity of a half-window as a (3, 64, 64) uint8 image, row 0 at the top."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dittogym.geometry import Box
from torchmpm.spline import quadratic_weights

#: Pixels of the image per axis, fine pixels per image pixel and axis, fine pixels of the whole window.
SIZE, BLOCK, RASTER = 64, 8, 1024
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


def background(boxes: Sequence[Box], origin: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Fine pixels of the crop that obstacles and targets set, (B, 512, 512) bool.

    A pixel belongs to a box if its left edge and its upper edge lie in the open box.
    """
    pixels = torch.arange(SIZE * BLOCK, device=origin.device)
    x = (column + pixels) / RASTER + origin[:, 0:1]
    y = (RASTER - row - pixels) / RASTER + origin[:, 1:2]
    mask = torch.zeros(len(origin), SIZE * BLOCK, SIZE * BLOCK, dtype=torch.bool, device=origin.device)
    for box in boxes:
        across, along = (x > box.left) & (x < box.right), (y > box.bottom) & (y < box.top)
        mask = mask | (along[:, :, None] & across[:, None, :])
    return mask


def pixel_means(position: Tensor, velocity: Tensor, seen: Tensor, row: Tensor, column: Tensor, mask: Tensor) -> Tensor:
    """The reference's raster: a fine pixel is set by any particle in it and has the velocity of the last one.

    Args:
        position: (B, N, 2) window coordinates, m.
        velocity: (B, N, 2) doubled, clipped velocities.
        seen: (B, N) bool, particles that are drawn.
        row: First fine row of the crop, (B, 1).
        column: First fine column of the crop, (B, 1).
        mask: (B, 512, 512) background.

    Returns:
        (B, 3, 64, 64) means over image pixels of occupancy and both velocities.
    """
    batch, count = seen.shape
    width = SIZE * BLOCK
    r = torch.trunc((1.0 - position[..., 1]) * float(RASTER)).to(torch.int64) - row
    c = torch.trunc(position[..., 0] * float(RASTER)).to(torch.int64) - column
    seen = seen & (position[..., 1] > 0) & (r >= 0) & (r < width) & (c >= 0) & (c < width)
    r, c = torch.where(seen, r, 0), torch.where(seen, c, 0)
    fine = r * width + c
    order = torch.where(seen, torch.arange(count, device=r.device), -1)
    last = torch.full((batch, width * width), -1, dtype=torch.int64, device=r.device)
    last = last.scatter_reduce(1, fine, order, "amax")
    wins = seen & (last.gather(1, fine) == order)
    new = wins & ~mask.flatten(1).gather(1, fine)
    values = torch.stack((new.to(velocity.dtype), *(wins * v for v in velocity.unbind(-1))))
    coarse = (r // BLOCK) * SIZE + c // BLOCK
    sums = torch.zeros(3, batch, SIZE * SIZE, dtype=velocity.dtype, device=r.device)
    sums = sums.scatter_add(2, coarse.expand(3, -1, -1), values).view(3, batch, SIZE, SIZE)
    blocks = mask.view(batch, SIZE, BLOCK, SIZE, BLOCK).sum((2, 4))
    sums[0] += blocks
    return sums.transpose(0, 1) / BLOCK**2


def splat_means(
    position: Tensor, velocity: Tensor, seen: Tensor, row: Tensor, column: Tensor, mask: Tensor, share: float
) -> Tensor:
    """What the reference's raster of a full-size robot would show on average, from fewer particles.

    Particles are spread over image pixels by quadratic B-splines, which gives the number n of full-size particles to
    expect in a pixel; the share of its fine pixels that they hit is ``1 - exp(-n / SATURATION)``.

    Args:
        position: (B, N, 2) window coordinates, m.
        velocity: (B, N, 2) doubled, clipped velocities.
        seen: (B, N) bool, particles that are drawn.
        row: First fine row of the crop, (B, 1).
        column: First fine column of the crop, (B, 1).
        mask: (B, 512, 512) background.
        share: Full-size particles that one particle stands for.

    Returns:
        (B, 3, 64, 64) means over image pixels of occupancy and both velocities.
    """
    batch = len(seen)
    u = position[..., 0] * (RASTER / BLOCK) - column / BLOCK - 0.5
    w = (1.0 - position[..., 1]) * (RASTER / BLOCK) - row / BLOCK - 0.5
    seen = seen & (u.abs() < 2 * SIZE) & (w.abs() < 2 * SIZE)
    u, w = torch.where(seen, u, 0.0), torch.where(seen, w, 0.0)
    base_u, base_w = torch.floor(u - 0.5), torch.floor(w - 0.5)
    weight = quadratic_weights(w - base_w)[:, :, None] * quadratic_weights(u - base_u)[:, None]
    offset = torch.arange(3, device=u.device)
    r = base_w.to(torch.int64)[:, None, None] + offset[:, None, None]
    c = base_u.to(torch.int64)[:, None, None] + offset[:, None]
    inside = (r >= 0) & (r < SIZE) & (c >= 0) & (c < SIZE) & seen[:, None, None]
    ids = (r.clamp(0, SIZE - 1) * SIZE + c.clamp(0, SIZE - 1)).flatten(1)
    weight = torch.where(inside, weight, 0.0) * share
    values = torch.stack((weight, *(weight * v[:, None, None] for v in velocity.unbind(-1)))).flatten(2)
    sums = torch.zeros(3, batch, SIZE * SIZE, dtype=velocity.dtype, device=u.device)
    sums = sums.scatter_add(2, ids.expand(3, -1, -1), values).view(3, batch, SIZE, SIZE)
    expected = sums[0]
    hit = 1.0 - torch.exp(-expected / SATURATION)
    free = 1.0 - mask.view(batch, SIZE, BLOCK, SIZE, BLOCK).to(velocity.dtype).mean((2, 4))
    per_particle = torch.where(expected > 0, hit / torch.where(expected > 0, expected, 1.0), 0.0)
    return torch.stack((1.0 - free * (1.0 - hit), sums[1] * per_particle, sums[2] * per_particle), dim=1)


def quantise(means: Tensor) -> Tensor:
    """Code block means (B, 3, 64, 64) as uint8: occupancy 0..255, zero velocity at 132, truncated."""
    occupancy = 255.0 * means[:, :1]
    velocity = 10.0 * (255.0 * (means[:, 1:] + CLIP) / (2 * CLIP) - 127.0) + 127.0
    return torch.cat((occupancy, velocity), dim=1).clamp(0.0, 255.0).to(torch.uint8)
