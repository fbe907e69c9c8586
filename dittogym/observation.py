"""The observation (3, 64, 64): occupancy and velocity in the half metre around the robot, row 0 at the top.

Drawn from particles, obstacles and goal in torch operations, or in one C++ function or CUDA kernel, whose bytes are the
same or one off. Crop and background also exist as smooth functions, see ``docs/concepts/gradients.md``.
"""

from __future__ import annotations

import ctypes
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from dittogym import cuda_picture
from dittogym.geometry import GRID, Box, Centre, Window, centre_in_window
from torchmpm.backends import warn_eager
from torchmpm.native.cuda.compiler import unavailable
from torchmpm.native.cuda.driver import Driver
from torchmpm.native.cuda.launcher import CUDA
from torchmpm.native.library import POOL, build, thread_pool
from torchmpm.native.tables import members
from torchmpm.sampling import sobol
from torchmpm.transfer import quadratic_weights
from torchmpm.tree import cached_tensors, transforming

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
#: silhouette (occupancy >= 80 / 255) begins at n = 25, where it differs least from that of :func:`pixel_means`.
SATURATION = 66.4
#: A pixel belongs to the silhouette if its occupancy code reaches this (21 of 64 fine pixels hit).
OCCUPIED = 80
#: Expected full-size particles in a pixel at which it belongs to the silhouette with probability 1/2, and the width of
#: the transition.
OCCUPIED_COUNT, OCCUPIED_WIDTH = 24.8, 3.3
#: Pixels around the image that splats at its edge reach into.
FRAME = 3
#: Fine pixels by which truncation shifts a moving crop, and the rule of :func:`draw_boxes` a box, on average.
HALF = 0.5


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
    pixels: bool  # Whether each particle sets a pixel, as with full particle counts, instead of splats
    native: bool  # Whether to draw in C++ or CUDA where that is possible

    def observe(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """The image (B, 3, 64, 64) uint8; particles that are not finite are not drawn."""
        arrays = (x.detach(), v.detach(), origin.detach(), centre.detach())
        if not self.native or x.device.type not in ("cpu", "cuda") or transforming():  # which cannot look into them
            return self.draw(*arrays)
        draw = _drawing(self, x.dtype, x.device)
        if isinstance(draw, str):
            warn_eager("the observation", draw)
            return self.draw(*arrays)
        return draw(*arrays)

    def draw(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """:meth:`observe` in torch operations."""
        return self.levels(x, v, origin, centre).to(torch.uint8)

    def levels(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """The image before it is rounded down, (B, 3, 64, 64), 0 to 255."""
        row, column = crop_corner(centre_in_window(self.view, centre, origin))
        shown = self.raster_input(x, v, origin, row, column)
        alike = not self.window.moves and None not in self.view  # for all elements
        corners = (corner[:1] if alike else corner for corner in (origin, row, column))
        shown = shown._replace(background=draw_boxes(self.boxes, *corners))
        return encode(pixel_means(shown) if self.pixels else splat_means(shown))

    def observe_smoothly(self, x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> Tensor:
        """The image in the units of the uint8 one as a smooth function of its arguments.

        Particles are splats for every particle count, and crop and background move with the robot without steps. The
        derivative jumps only where values or velocities (5 m/s) saturate, at the edge of the simulated window, and
        where edges of boxes meet edges of pixels.
        """
        follows = (self.view[0] is None and not self.window.moves, self.view[1] is None)
        row, column = smooth_crop_corner(centre_in_window(self.view, centre, origin), follows)
        means = splat_means(self.raster_input(x, v, origin, row, column))
        if self.boxes:
            free = 1.0 - box_fraction(self.boxes, origin, row, column)
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


def encode(means: Tensor) -> Tensor:
    """Block means (B, 3, 64, 64) in the units of the uint8 image: occupancy 0 to 255, zero velocity at 132."""
    occupancy = 255.0 * means[:, :1]
    velocity = 10.0 * (255.0 * (means[:, 1:] + CLIP) / (2 * CLIP) - 127.0) + 127.0
    return torch.cat((occupancy, velocity), dim=1).clamp(0.0, 255.0)


def silhouette(observation: Tensor) -> Tensor:
    """Return which pixels of an observation show matter: those whose occupancy is at least 80 of 255.

    Args:
        observation: (B, 3, 64, 64) uint8.

    Returns:
        (B, 64, 64) bool.
    """
    return observation[:, 0] >= OCCUPIED


def soft_silhouette(observation: Tensor) -> Tensor:
    """Return the probability with which each pixel would belong to the :func:`silhouette`, for gradients.

    With n the number of full-size particles that are expected in a pixel, it is ``sigmoid((n - 24.8) / 3.3)``, which
    was fitted to random positions of full particle counts. The number n follows from the occupancy
    ``1 - exp(-n / 66.4)``, which includes obstacles and goal.

    Args:
        observation: (B, 3, 64, 64) from :func:`dittogym.core.soft_observation`.

    Returns:
        (B, 64, 64), from 0 to 1.
    """
    free = (1.0 - observation[:, 0] / 255.0).clamp_min(0.0)
    return 1.0 / (1.0 + math.exp(OCCUPIED_COUNT / OCCUPIED_WIDTH) * free ** (SATURATION / OCCUPIED_WIDTH))


def goal_box(point: tuple[float, float]) -> Box:
    """What the observation shows of a goal: fine pixels less than ten away in both directions."""
    (x, y), half = point, 10 / RASTER
    return Box(x - half, x + half, y - half, y + half)


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
    pixels = torch.arange(SIZE * BLOCK, dtype=origin.dtype, device=origin.device)
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
    """The raster of full counts, (B, 3, 64, 64): a particle sets its fine pixel, the last in it gives the velocity."""
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
    """What :func:`pixel_means` of full-size bodies would show on average, (B, 3, 64, 64), from fewer particles.

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
    share = torch.where(some, hit / torch.where(some, expected_moving, 1.0), 0.0)  # of one expected particle
    occupancy = 1.0 - free * torch.exp(-expected / SATURATION)
    return torch.stack((occupancy, sums[1] * share, sums[2] * share), dim=1)


def _splat_weights(shown: RasterInput) -> tuple[Tensor, Tensor]:
    """Weights (B, 9, N) of the pixels around each particle, and their indices (B, 9 N) in the framed image."""
    x, y = shown.position.unbind(-1)
    corner, width = torch.stack((shown.column, shown.row)).to(x), SIZE + 2 * FRAME
    at = torch.stack((x, 1.0 - y)) * (RASTER / BLOCK) - corner / BLOCK - 0.5  # (2, B, N) pixels rightwards, downwards
    middle, reach = 0.5 * SIZE, 0.5 * SIZE + 1.5
    near = shown.visible & ((at - middle).abs() < reach).all(0)
    at = torch.where(near, at, 0.0)
    base = torch.floor(at - 0.5)
    across, along = quadratic_weights(at - base)
    weight = (along[:, :, None] * (across * (near * shown.weight)[:, None])[:, None]).flatten(1, 2)
    first = ((base[1] + FRAME) * width + base[0] + FRAME).to(torch.int64)
    offset = torch.arange(3, device=at.device)
    ids = (first[:, None] + (offset[:, None] * width + offset).view(9, 1)).flatten(1)
    return weight, ids


_SOURCE = Path(__file__).parent / "picture.cpp"


class Picture(ctypes.Structure):
    """The arguments of one call, as ``struct Picture`` in ``picture.cpp``."""

    _fields_ = [
        *members(ctypes.c_int64, "batch", "particles", "threads", "pixels"),
        *members(ctypes.c_void_p, *POOL),
        *members(ctypes.c_int64, "bodies", "boxes"),
        *members(ctypes.c_void_p, "body", "box"),
        ("view", ctypes.c_double * 2),
        *members(ctypes.c_double, "margin", "extent", "clip", "saturation"),
        *members(ctypes.c_void_p, "x", "v", "origin", "centre", "image"),
    ]


#: Draws x, v, origin and centre of :class:`Camera`.
Drawing: TypeAlias = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


@functools.lru_cache(maxsize=64)
def _drawing(camera: Camera, dtype: torch.dtype, device: torch.device) -> Drawing | str:
    """What draws on a device, or why nothing but :meth:`Camera.draw` does."""
    try:
        return native_drawing(camera, dtype) if device.type == "cpu" else cuda_drawing(camera, dtype, device)
    except (ValueError, RuntimeError) as error:  # no compiler, or it failed
        return str(error)


def tables(camera: Camera, device: torch.device) -> dict[str, Tensor]:
    """Of each body, particles, full-size particles that one stands for, and whether its velocity is hidden; boxes."""
    bodies = list(zip(camera.counts, camera.particle_weight, camera.hidden_velocity, strict=True))
    edges = [(b.left, b.right, b.bottom, b.top, b.closed) for b in camera.boxes]
    named = {"body": bodies, "box": edges}
    return {name: torch.tensor(rows, dtype=torch.float64, device=device) for name, rows in named.items()}


def arrays_of(x: Tensor, v: Tensor, origin: Tensor, centre: Tensor) -> dict[str, Tensor]:
    """Contiguous arrays of particles by component and of windows, and one for the image."""
    arrays = {"x": x.movedim(-1, 0), "v": v.movedim(-1, 0), "origin": origin, "centre": centre}
    image = torch.empty(len(x), *SHAPE, dtype=torch.uint8, device=x.device)
    return {name: array.contiguous() for name, array in arrays.items()} | {"image": image}


def numbers(camera: Camera) -> dict[str, Any]:
    """What the C++ function and the CUDA kernel read besides :func:`tables`."""
    return {
        "pixels": camera.pixels,
        "bodies": len(camera.counts),
        "boxes": len(camera.boxes),
        "view": tuple(math.nan if c is None else c for c in camera.view),
        "margin": GRID.margin,
        "extent": GRID.extent,
        "clip": CLIP,
        "saturation": SATURATION,
    }


def native_drawing(camera: Camera, dtype: torch.dtype) -> Drawing:
    """A function that draws what a camera sees as one C++ call, for tensors on the CPU."""
    kind = {torch.float32: "float", torch.float64: "double"}[dtype]
    function = getattr(build(_SOURCE, "-ffp-contract=off"), f"dittogym_draw_{kind}")
    fixed, constants = tables(camera, torch.device("cpu")), numbers(camera)

    def draw(*given: Tensor) -> Tensor:
        arrays = arrays_of(*given) | fixed
        pointers = {name: array.data_ptr() for name, array in arrays.items()}
        _, batch, particles = arrays["x"].shape
        sizes = {"batch": batch, "particles": particles, "threads": torch.get_num_threads()}
        call = Picture(**sizes, **pointers, **constants, **thread_pool())
        if function(ctypes.byref(call)):
            raise MemoryError("there is not enough memory to draw the observation")
        return arrays["image"]

    return draw


def cuda_drawing(camera: Camera, dtype: torch.dtype, device: torch.device, driver: Driver = CUDA.driver) -> Drawing:
    """A function that draws what a camera sees as one CUDA kernel, which has been tried against :meth:`Camera.draw`.

    Raises:
        ValueError: The kernel cannot be compiled for the device, or draws something else.
    """
    if device.type == "cuda" and (reason := unavailable(device)) is not None:
        raise ValueError(reason)
    fixed, constants = tables(camera, device), numbers(camera)
    full = sum(n * weight for n, weight in zip(camera.counts, camera.particle_weight, strict=True))
    kernel = cuda_picture.Kernel.of(dtype)

    def draw(*given: Tensor) -> Tensor:
        arrays = arrays_of(*given) | fixed
        cuda_picture.draw(driver, kernel, arrays, full, **constants)
        return arrays["image"]

    places = torch.from_numpy(sobol(2 * sum(camera.counts), seed=0)).view(2, -1, 2).to(device, dtype)
    origin = places.new_zeros(2, 2)
    arrays = (places, 10.0 - 20.0 * places, origin, origin + 0.5)
    difference = int((draw(*arrays).int() - camera.draw(*arrays).int()).abs().max())
    if difference > 1:
        raise ValueError(f"its CUDA kernel was tried on {device}, and a pixel differed by {difference} levels")
    return draw
