"""The observation's format: sizes, the code of occupancy and velocity, and what counts as the robot's silhouette."""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: Pixels of the image per axis.
SIZE = 64
#: Fine pixels per image pixel and axis.
BLOCK = 8
#: Fine pixels per axis of the whole window, which is 1 m wide; the image shows half of it.
RASTER = 1024
#: Shape of an observation.
SHAPE = (3, SIZE, SIZE)
#: Velocities are doubled and clipped to this before averaging.
CLIP = 10.0
#: Occupancy of a cell in which n full-size particles are expected: 1 - exp(-n / SATURATION). Fitted so that the
#: silhouette (occupancy >= 80 / 255) begins at n = 25, where it differs least from that of the pixel raster.
SATURATION = 66.4
#: A pixel belongs to the silhouette if its occupancy code reaches this (21 of 64 fine pixels hit).
OCCUPIED = 80
#: Expected full-size particles in a pixel at which it belongs to the silhouette with probability 1/2, and the width of
#: the transition.
OCCUPIED_COUNT, OCCUPIED_WIDTH = 24.8, 3.3


def encode(means: Tensor) -> Tensor:
    """Block means (B, 3, 64, 64) in the units of the uint8 image: occupancy 0 to 255, zero velocity at 132."""
    occupancy = 255.0 * means[:, :1]
    velocity = 10.0 * (255.0 * (means[:, 1:] + CLIP) / (2 * CLIP) - 127.0) + 127.0
    return torch.cat((occupancy, velocity), dim=1).clamp(0.0, 255.0)


def silhouette(observation: Tensor) -> Tensor:
    """Occupied pixels of an observation (B, 3, 64, 64) uint8: (B, 64, 64) bool."""
    return observation[:, 0] >= OCCUPIED


def soft_silhouette(observation: Tensor) -> Tensor:
    """Probability of each pixel to belong to the :func:`silhouette` with full particles.

    ``sigmoid((n - 24.8) / 3.3)`` for n expected full particles, fitted to random positions, as a function of the
    occupancy ``1 - exp(-n / SATURATION)``, which includes the background.

    Args:
        observation: (B, 3, 64, 64) from :func:`dittogym.core.soft_observation`.

    Returns:
        (B, 64, 64), 0 to 1.
    """
    free = (1.0 - observation[:, 0] / 255.0).clamp_min(0.0)
    return 1.0 / (1.0 + math.exp(OCCUPIED_COUNT / OCCUPIED_WIDTH) * free ** (SATURATION / OCCUPIED_WIDTH))
