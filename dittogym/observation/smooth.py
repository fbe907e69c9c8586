"""Crop and background of the observation as smooth functions; see ``docs/concepts/gradients.md``."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dittogym.geometry import Box
from dittogym.observation.image import BLOCK, RASTER, SIZE
from dittogym.observation.raster import crop_corner

#: Fine pixels by which truncation shifts a moving crop, and the rule of ``draw_boxes`` a box, on average.
HALF = 0.5


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
