"""The observation as a smooth function of the particles, for losses on what the robot looks like.

The uint8 image counts fine pixels that are hit, so it has no derivative. Here particles are spread over image pixels by
quadratic B-splines at every tier, which gives the number n of full-size particles to expect in a pixel; crop and
background move with the robot without steps. How far that is from the true image: ``docs/concepts/gradients.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dittogym import core as dynamics
from dittogym.geometry import Box
from dittogym.observation import raster as obs
from dittogym.observation.window import in_window
from dittogym.spec import TaskSpec

#: Expected full-size particles in a pixel at which it belongs to the silhouette (occupancy >= 80 of 255) of every other
#: random layout, and the width of the transition.
ON_COUNT, ON_WIDTH = 24.8, 3.3
#: Fine pixels by which truncation shifts a moving crop on average, and by which the rule of
#: :func:`dittogym.observation.raster.draw_boxes` (left and upper edge in the box) shifts a box to the right and
#: downwards.
HALF = 0.5


def soft_observation(model: dynamics.Model, state: dynamics.EnvState) -> Tensor:
    """The image in the units of the uint8 one, with the graph of the state.

    Like there, occupancy lies between 0 and 255 and velocities saturate at 0 and 255, where their derivative is zero.
    The derivative is continuous but for these ends, the cap on velocities (5 m/s), particles at the edge of the
    simulated window, and edges of drawn boxes that meet edges of pixels.

    Args:
        model: The task.
        state: The present state.

    Returns:
        (B, 3, 64, 64) occupancy and velocities (x, y); zero velocity at 132.
    """
    origin = state.origin
    row, column = soft_corner(model.spec, in_window(model.spec.view, state.centre, origin))
    sight = dynamics.look(model, state.particles, origin, row, column)
    means = obs.splat_means(sight, model.per_particle(model.shares, origin))
    if boxes := model.spec.drawn:
        free = 1.0 - soft_share(boxes, origin, row, column)
        means = torch.cat((1.0 - free[:, None] * (1.0 - means[:, :1]), means[:, 1:]), dim=1)
    return obs.coded(means)


def soft_silhouette(observation: Tensor) -> Tensor:
    """Probability of each pixel to count as occupied in the full-size image (occupancy code >= 80).

    ``sigmoid((n - 24.8) / 3.3)`` for n expected full-size particles, fitted to random layouts; written in the occupancy
    ``1 - exp(-n / SATURATION)``, which includes the background.

    Args:
        observation: (B, 3, 64, 64) from :func:`soft_observation`.

    Returns:
        (B, 64, 64), 0 to 1.
    """
    free = (1.0 - observation[:, 0] / 255.0).clamp_min(0.0)
    return 1.0 / (1.0 + math.exp(ON_COUNT / ON_WIDTH) * free ** (obs.SATURATION / ON_WIDTH))


def soft_corner(spec: TaskSpec, centre: Tensor) -> tuple[Tensor, Tensor]:
    """First fine row and column of the crop around ``centre`` (B, 2), window coordinates in m; (B, 1) each.

    Where the robot can move in the window and the crop follows it, without truncation; else as
    :func:`dittogym.observation.raster.crop_corner`.
    """
    half = obs.SIZE * obs.BLOCK // 2
    row, column = (corner.to(centre.dtype) for corner in obs.crop_corner(centre))
    first = (obs.RASTER * centre - HALF - half).clamp(0.0, obs.RASTER - 2.0 * half)
    if spec.view[0] is None and spec.window.follow is None:
        column = first[:, 0:1]
    if spec.view[1] is None:
        row = obs.RASTER - 2 * half - first[:, 1:2]
    return row, column


def soft_share(boxes: Sequence[Box], origin: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Share of each image pixel that boxes cover, (B, 64, 64), for a window at ``origin`` (B, 2), m.

    Boxes may touch; where they overlap within a pixel that they do not fill, the overlap counts twice.
    """
    pixel = torch.arange(obs.SIZE, device=origin.device, dtype=origin.dtype)
    width = obs.BLOCK / obs.RASTER
    left = (column + obs.BLOCK * pixel - HALF) / obs.RASTER + origin[:, 0:1]
    bottom = (obs.RASTER - row - obs.BLOCK * (pixel + 1) + HALF) / obs.RASTER + origin[:, 1:2]
    share = torch.zeros_like(bottom[:, :, None])
    for box in boxes:
        along, across = _overlap(bottom, width, box.bottom, box.top), _overlap(left, width, box.left, box.right)
        share = share + along[:, :, None] * across[:, None]
    return share.clamp_max(1.0)


def _overlap(start: Tensor, width: float, low: float, high: float) -> Tensor:
    """Share of the intervals of a ``width`` from ``start`` on that lies between ``low`` and ``high``."""
    return ((start + width).clamp_max(high) - start.clamp_min(low)).clamp_min(0.0) / width
