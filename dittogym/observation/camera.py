"""The camera of a task: from positions and velocities to the observation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dittogym.geometry import Box
from dittogym.observation import native, raster
from dittogym.observation.image import CLIP, encode
from dittogym.observation.raster import RasterInput
from dittogym.window import GRID, Centre, Window, centre_in_window
from torchmpm.backends import warn_eager
from torchmpm.tree import cached_tensors, transforming


@dataclass(frozen=True, eq=False)
class Camera:
    """What a task's observations show, and how.

    Its functions take arrays: ``x`` and ``v`` (B, N, 2) positions and velocities of all particles in the world, m and
    m/s; ``origin`` (B, 2) the lower left corner of the window, m; ``centre`` (B, 2) the robot's centre, m.
    """

    view: Centre  # Centre of the image
    window: Window  # Where the window lies
    boxes: tuple[Box, ...]  # What is shown besides particles
    counts: tuple[int, ...]  # Particles of each body
    particle_weight: tuple[float, ...]  # By body, the full-size particles that one particle stands for
    hidden_velocity: tuple[bool, ...]  # By body, whether the velocity channels leave it out
    pixels: bool  # Whether to use the reference's pixel raster instead of splats
    native: bool  # Whether to draw in C++ where that is possible

    def observe(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """The image (B, 3, 64, 64) uint8; particles that are not finite are not drawn."""
        arrays = (x.detach(), v.detach(), origin.detach(), centre.detach())
        if not self.native or x.device.type != "cpu" or transforming():  # torch.func cannot look into the C++ function
            return self.draw(*arrays)
        bodies = tuple(zip(self.counts, self.particle_weight, self.hidden_velocity, strict=True))
        try:
            drawing = native.drawing(self.view, self.boxes, bodies, self.pixels, x.dtype)
        except ValueError as error:  # no compiler, or it failed
            warn_eager("the observation", str(error))
            return self.draw(*arrays)
        return drawing(*arrays)

    def draw(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """:meth:`observe` in torch operations."""
        row, column = raster.crop_corner(centre_in_window(self.view, centre, origin))
        shown = self.raster_input(x, v, origin, row, column)
        alike = not self.window.moves and None not in self.view  # for all elements
        corners = (corner[:1] if alike else corner for corner in (origin, row, column))
        shown = shown._replace(background=raster.draw_boxes(self.boxes, *corners))
        return encode(raster.pixel_means(shown) if self.pixels else raster.splat_means(shown)).to(torch.uint8)

    def observe_smoothly(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """The image in the units of the uint8 one as a smooth function of its arguments.

        Particles are splats for every particle count, and crop and background move with the robot without steps. The
        derivative jumps only where values or velocities (5 m/s) saturate, at the edge of the simulated window, and
        where edges of boxes meet edges of pixels.
        """
        follows = (self.view[0] is None and not self.window.moves, self.view[1] is None)
        row, column = raster.smooth_crop_corner(centre_in_window(self.view, centre, origin), follows)
        means = raster.splat_means(self.raster_input(x, v, origin, row, column))
        if self.boxes:
            free = 1.0 - raster.box_fraction(self.boxes, origin, row, column)
            means = torch.cat((1.0 - free[:, None] * (1.0 - means[:, :1]), means[:, 1:]), dim=1)
        return encode(means)

    def raster_input(self, x: Tensor, v: Tensor, origin: Tensor, row: Tensor, column: Tensor) -> RasterInput:
        """The particles that an image with its corner in a fine ``row`` and ``column`` (B, 1) shows."""
        finite = torch.isfinite((x + v).detach().sum(-1))
        visible = finite & GRID.contains(x[..., 0], origin[:, 0:1])
        some = any(self.hidden_velocity)
        hidden = per_particle(self.counts, self.hidden_velocity, torch.bool, x.device) if some else None
        moving = visible if hidden is None else visible & ~hidden
        return RasterInput(
            position=x - origin[:, None],
            velocity=(2.0 * torch.where(moving[..., None], v, 0.0)).clamp(-CLIP, CLIP),
            weight=per_particle(self.counts, self.particle_weight, origin.dtype, x.device),
            visible=visible,
            hidden_velocity=hidden,
            row=row,
            column=column,
        )


@cached_tensors
def per_particle(
    counts: tuple[int, ...], values: tuple[float, ...], dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Values of the bodies as (N,) over all particles."""
    repeats = torch.tensor(counts, device="cpu")
    return torch.tensor(values, dtype=dtype, device="cpu").repeat_interleave(repeats).to(device)
