"""Pictures of a simulation as arrays; no window system, no files."""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from dittogym.geometry import Box
from dittogym.model import EnvState, Model
from dittogym.render.colours import body_colours, particle_colours
from torchmpm import checks
from torchmpm.materials.body import slices

GROUND = (248, 246, 240)
SOLID = (112, 119, 130)
GRID = (226, 224, 217)
TARGET = (247, 198, 98)
#: Distance of the marks on the ground that show how far the window has moved, m.
MARK = 0.1
#: Radius of a dot at full size, just large enough to close a body at its initial density, m.
FULL_SIZE_RADIUS = 0.0015
#: Pictures are drawn this many times larger, then averaged down.
OVERSAMPLING = 2
#: Pixels per side of the largest picture.
LARGEST = 8192


def frame(model: Model, state: EnvState, index: int, actuation: Tensor | None, size: int) -> np.ndarray:
    """Draw one element of a batch, (size, size, 3) uint8 RGB: window, obstacles, target and particles by body."""
    if not isinstance(index, (int, np.integer)) or not 0 <= index < len(state.steps):
        raise IndexError(f"index must be between 0 and {len(state.steps) - 1}, got {index!r}")
    index = int(index)
    checks.whole("size", size, 16, LARGEST)
    spec, particles = model.spec, state.particles[index].detach()
    origin = state.origin[index].detach().cpu().double().numpy()
    canvas = Canvas(size * OVERSAMPLING, origin)
    canvas.marks()
    if spec.goal is not None:
        canvas.goal(spec.goal)
    if spec.target is not None:
        canvas.target(spec.target, state.centre[index].detach().cpu().double().numpy())
    for obstacle in spec.obstacles:
        for box in obstacle.boxes:
            ground = box == Box(top=box.top)
            canvas.box(box, filled=bool(obstacle.observed_boxes) or ground)
    x = particles.x[0].cpu().numpy().astype(np.float64)
    if actuation is None:
        colours = body_colours(model)
    else:
        colours = particle_colours(model, state, index, actuation, "muscle")
    parts = [part for _, part in slices(model.solver.bodies)]
    for part, weight in reversed(list(zip(parts, model.camera.particle_weight, strict=True))):  # the robot last, on top
        radius = max(1, round(FULL_SIZE_RADIUS * np.sqrt(weight) * canvas.pixels))
        canvas.dots(x[part], colours[part], radius)
    return cv2.resize(canvas.image, (size, size), interpolation=cv2.INTER_AREA)


class Canvas:
    """An image of the window at ``origin`` (2,), m, that is drawn into by world coordinates."""

    def __init__(self, pixels: int, origin: np.ndarray) -> None:
        self.pixels, self.origin = pixels, origin
        self.image = np.empty((pixels, pixels, 3), np.uint8)
        cv2.rectangle(self.image, (0, 0), (pixels, pixels), GROUND, cv2.FILLED)  # much faster than NumPy

    def marks(self) -> None:
        """Vertical lines at round world positions, so that the motion of the window is seen."""
        for k in range(int(np.ceil(self.origin[0] / MARK)), int(np.floor((self.origin[0] + 1.0) / MARK)) + 1):
            column = round((k * MARK - self.origin[0]) * self.pixels)
            cv2.line(self.image, (column, 0), (column, self.pixels), GRID, 1 if k % 5 else 4)

    def box(self, box: Box, *, filled: bool) -> None:
        """A box, or only its outline."""
        left, right = np.clip((np.array((box.left, box.right)) - self.origin[0]) * self.pixels, -9, self.pixels + 9)
        low, high = np.clip((np.array((box.bottom, box.top)) - self.origin[1]) * self.pixels, -9, self.pixels + 9)
        corners = (round(left), round(self.pixels - high)), (round(right), round(self.pixels - low))
        cv2.rectangle(self.image, *corners, SOLID, cv2.FILLED if filled else 3)

    def goal(self, goal: tuple[float, float]) -> None:
        """A disc at a point of the world."""
        middle = (np.array(goal) - self.origin) * self.pixels
        if self._near(middle):
            cv2.circle(self.image, (round(middle[0]), round(self.pixels - middle[1])), self.pixels // 60, TARGET, -1)

    def target(self, target: np.ndarray, centre: np.ndarray) -> None:
        """The picture to match, half a window wide, around the robot's centre."""
        middle = (centre - self.origin) * self.pixels
        if not self._near(middle):
            return
        width = self.pixels // 2
        mask = cv2.resize(target.astype(np.uint8), (width, width), interpolation=cv2.INTER_NEAREST)
        outlines, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)  # of bodies and of their holes
        corner = np.array((round(middle[0]) - width // 2, self.pixels - round(middle[1]) - width // 2))
        shifted = [outline + corner for outline in outlines]
        cv2.fillPoly(self.image, shifted, TARGET)  # all at once: what lies in two of them stays empty

    def _near(self, middle: np.ndarray) -> bool:
        """Whether a figure around here may be seen; OpenCV cannot be given numbers of any size."""
        return bool((np.abs(middle) < 4 * self.pixels).all())

    def dots(self, position: np.ndarray, colours: np.ndarray, radius: int) -> None:
        """Filled circles at world positions (N, 2); what is off the picture or not finite is left out."""
        column = (position[:, 0] - self.origin[0]) * self.pixels
        row = (1.0 - (position[:, 1] - self.origin[1])) * self.pixels
        seen = (column >= 0) & (column < self.pixels) & (row >= 0) & (row < self.pixels)
        if not seen.any():
            return
        column, row, colours = column[seen].astype(int), row[seen].astype(int), colours[seen]
        top, left = max(0, row.min() - radius), max(0, column.min() - radius)
        part = self.image[top : row.max() + radius + 1, left : column.max() + radius + 1]
        numbers = np.zeros(part.shape[:2], np.float32)  # of the particles, from 1 on; float32 counts to 16 million
        numbers[row - top, column - left] = np.arange(1, len(row) + 1)
        reach = np.arange(-radius, radius + 1)
        disc = np.add.outer(reach**2, reach**2) <= radius**2
        last = cv2.dilate(numbers, disc.astype(np.uint8)).astype(np.int32)  # the particle on top in each pixel
        palette = np.zeros((len(row) + 1, 4), np.uint8)  # four bytes, which are looked up as one number
        palette[1:, :3] = colours
        drawn = palette.view(np.uint32)[:, 0][last].view(np.uint8).reshape(*last.shape, 4)
        cv2.copyTo(drawn[..., :3], (last > 0).astype(np.uint8), part)
