"""Pictures of a simulation as arrays; no window system, no files."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dittogym.render.scene import SCALES, Scene, Shot, Solid, check_view

GROUND, SOLID, TARGET = (248, 246, 240), (112, 119, 130), (247, 198, 98)
GRID, INK = (226, 224, 217), (40, 44, 52)
#: Distance of the marks that show how far the robot has moved, m.
MARK = 0.1
MUSCLES = SCALES["muscle"].palette()
#: Bits behind the point of the coordinates of polygons, which OpenCV takes as integers.
SHIFT = 4


def frame(
    scene: Scene,
    shot: Shot,
    size: int = 512,
    zoom: float | None = None,
    muscles: bool = True,
    caption: tuple[str, str] | None = None,
) -> np.ndarray:
    """Draw one moment, (size, size, 3) uint8 RGB.

    Args:
        scene: The static parts of the scene.
        shot: The moment.
        size: Pixels per side.
        zoom: The picture shows 1 / zoom metres; ``None``: a little more than the robot observes.
        muscles: Colour the robot by its muscles: contraction red, expansion blue.
        caption: What to write into the upper left and the upper right corner.
    """
    width = check_view(size, zoom)
    canvas = Canvas(size, shot.corner(width), width)
    marks = canvas.marks()
    canvas.target(scene.target, shot.centre)
    for solid in scene.solids:
        canvas.box(solid)
    canvas.ruler(marks)
    ends = np.cumsum([body.count for body in scene.bodies])
    for number, (end, body) in reversed(list(enumerate(zip(ends, scene.bodies, strict=True)))):  # the robot on top
        colours = np.array(body.colour, np.uint8)
        if number == 0:
            if scene.goal is not None:
                canvas.goal(scene.goal)
            if muscles and "muscle" in shot.values:
                colours = MUSCLES[shot.values["muscle"]]
        canvas.dots(shot.x[end - body.count : end], colours, body.radius)
    if caption is not None:
        canvas.caption(*caption)
    return canvas.image


def pace(speed: float) -> str:
    """A playback speed in words; 1 is real time."""
    if speed == 1:
        return "real time"
    factor, word = (1 / speed, "slower") if speed < 1 else (speed, "faster")
    return f"{factor:.0f} times {word}" if factor >= 9.95 else f"{factor:.2g} times {word}"


def png(picture: np.ndarray) -> bytes:
    """A picture (H, W, 3) uint8 RGB as a PNG file."""
    return cv2.imencode(".png", picture[..., ::-1])[1].tobytes()


class Canvas:
    """A square image of the world from the lower left ``corner`` (2,) on, m.

    Args:
        pixels: Its side.
        corner: (2,) m.
        width: What it shows, m.
    """

    def __init__(self, pixels: int, corner: np.ndarray, width: float = 1.0) -> None:
        self.pixels, self.corner, self.width, self.scale = pixels, corner, width, pixels / width
        self.image = np.empty((pixels, pixels, 3), np.uint8)
        cv2.rectangle(self.image, (0, 0), (pixels, pixels), GROUND, cv2.FILLED)  # much faster than NumPy

    def place(self, points: np.ndarray) -> np.ndarray:
        """Column and row (..., 2) of points in the world, m."""
        return np.asarray((points - self.corner) * (self.scale, -self.scale) + (0, self.pixels))

    def marks(self) -> list[tuple[float, int]]:
        """Draw lines at round positions; returns the position, m, and the column of each."""
        left = float(self.corner[0])
        found = []
        for k in range(int(np.ceil(left / MARK)), int(np.floor((left + self.width) / MARK)) + 1):
            column = round((k * MARK - left) * self.scale)
            cv2.line(self.image, (column, 0), (column, self.pixels), GRID, 1 if k % 5 else 2)
            found.append((k * MARK, column))
        return found

    def ruler(self, marks: list[tuple[float, int]]) -> None:
        """Write at the bottom where lines are, unless they are too close to each other."""
        font = max(10, self.pixels // 40)
        if MARK * self.scale < 3.5 * font:
            marks = [(x, column) for x, column in marks if round(x / MARK) % 5 == 0]
        written = -4 * font
        for x, column in marks:
            dark = self.image[-font, min(column, self.pixels - 1)].mean() < 150
            colour = (235, 235, 235) if dark else SOLID
            cv2.line(self.image, (column, self.pixels - font // 2), (column, self.pixels), colour, 2)
            middle = min(max(column, 2 * font), self.pixels - 2 * font)  # so that all of it is in the picture
            if middle - written >= 3.5 * font:  # also from one that was moved
                self.text(f"{x + 0.0:.1f} m", (middle, self.pixels - 5 * font // 3), font, colour, 0.5)
                written = middle

    def box(self, box: Solid) -> None:
        """A box, or only its outline."""
        low, high = self.place(np.array(((box.left, box.bottom), (box.right, box.top))))
        (left, bottom), (right, top) = np.clip((low, high), -9, self.pixels + 9)
        corners = self._fixed(np.array(((left, bottom), (right, bottom), (right, top), (left, top))))
        if box.filled:
            cv2.fillConvexPoly(self.image, corners, SOLID, cv2.LINE_AA, SHIFT)
        else:
            cv2.polylines(self.image, [corners], True, SOLID, 2, cv2.LINE_AA, SHIFT)

    def goal(self, goal: tuple[float, float]) -> None:
        """A disc at a point of the world."""
        middle = self.place(np.array(goal))
        if self._near(middle):
            radius = int(0.012 * self.scale * 2**SHIFT)
            cv2.circle(self.image, self._fixed(middle).tolist(), radius, TARGET, cv2.FILLED, cv2.LINE_AA, SHIFT)

    def target(self, outlines: tuple[np.ndarray, ...], centre: np.ndarray) -> None:
        """The picture to match, around the robot's centre."""
        if outlines and self._near(self.place(centre)):
            polygons = [self._fixed(self.place(outline + centre)) for outline in outlines]
            cv2.fillPoly(self.image, polygons, TARGET, cv2.LINE_AA, SHIFT)  # what lies in two of them stays empty

    def dots(self, position: np.ndarray, colours: np.ndarray, radius: float) -> None:
        """Filled circles of a radius in m at world positions (N, 2); only those that can be seen.

        Args:
            position: m.
            colours: One for all (3,), or (N, 3): a pixel takes that of the particle that is nearest to it.
            radius: m.
        """
        radius *= self.scale
        at = self.place(position.astype(np.float64))
        reach = int(np.ceil(radius)) + 1
        seen = ((at >= 0) & (at < self.pixels)).all(1)  # false where it is not finite
        if not seen.any():
            return
        column, row = at[seen].astype(int).T
        top, left = max(0, row.min() - reach), max(0, column.min() - reach)
        part = self.image[top : row.max() + reach + 1, left : column.max() + reach + 1]
        column, row = column - left, row - top
        empty = np.full(part.shape[:2], 255, np.uint8)
        empty[row, column] = 0
        if colours.ndim == 1:
            distance = cv2.distanceTransform(empty, cv2.DIST_L2, 5)
            drawn = np.empty_like(part)
            cv2.rectangle(drawn, (0, 0), drawn.shape[1::-1], colours.tolist(), cv2.FILLED)
        else:
            distance, nearest = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
            palette = np.zeros((len(row) + 1, 4), np.uint8)  # four bytes, which are looked up as one number
            palette[nearest[row, column], :3] = colours[seen]
            drawn = palette.view(np.uint32)[:, 0][nearest].view(np.uint8).reshape(*nearest.shape, 4)[..., :3]
        edge = np.nonzero(np.abs(distance - radius) < 0.5)
        cover = (radius + 0.5 - distance[edge])[:, None]
        below = part[edge]
        cv2.copyTo(drawn, (distance < radius).astype(np.uint8), part)
        part[edge] = below + cover * (drawn[edge].astype(np.float32) - below)

    def caption(self, left: str, right: str) -> None:
        """Write into both upper corners, on a light strip."""
        font = max(10, self.pixels // 32)
        strip = self.image[: 3 * font // 2]
        strip[:] = cv2.addWeighted(strip, 0.2, np.full_like(strip, 255), 0.8, 0)
        self.text(left, (font // 2, font // 4), font, INK, 0.0)
        self.text(right, (self.pixels - font // 2, font // 4), font, INK, 1.0)

    def text(self, text: str, at: tuple[int, int], size: int, colour: tuple[int, ...], align: float) -> None:
        """Write at a column and a row, the top of the line; ``align`` 0: to the right of it, 1: to the left of it."""
        mask = _text_mask(text, size)
        column, row = round(at[0] - align * mask.shape[1]), at[1]
        mask = mask[: max(0, self.pixels - row), max(0, -column) : max(0, self.pixels - column)]
        part = self.image[row : row + mask.shape[0], max(0, column) : max(0, column) + mask.shape[1]]
        part[:] = mask * np.array(colour) + (1 - mask) * part

    def _near(self, middle: np.ndarray) -> bool:
        """Whether a figure around here may be seen; OpenCV cannot be given numbers of any size."""
        return bool((np.abs(middle) < 4 * self.pixels).all())

    @staticmethod
    def _fixed(points: np.ndarray) -> np.ndarray:
        """Coordinates as OpenCV takes them; it counts from the middle of the first pixel."""
        return np.asarray(np.round((points - 0.5) * 2**SHIFT).astype(np.int32))


@functools.lru_cache(maxsize=512)
def _text_mask(text: str, size: int) -> np.ndarray:
    """A line of text, (H, W, 1) from 0 to 1."""
    font = ImageFont.load_default(size)
    left, _, right, bottom = font.getbbox(text)
    image = Image.new("L", (int(right - left) + 1, int(bottom) + 1))
    ImageDraw.Draw(image).text((-left, 0), text, 255, font)
    return np.asarray(image, np.float32)[..., None] / 255
