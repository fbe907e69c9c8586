"""Pictures of a simulation as arrays; no window system, no files."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dittogym.geometry import NODES
from dittogym.render.scene import RADIUS, SCALES, Scene, Shot, Solid, check_view
from torchmpm import checks

GROUND, SOLID, TARGET = (248, 246, 240), (112, 119, 130), (247, 198, 98)
#: Lines, every second half metre of the background, every second tenth of the floor, outlines of bodies, text.
GRID, BAND, TILE, OUTLINE, INK = (226, 224, 217), (240, 237, 228), (130, 137, 148), (29, 63, 72), (40, 44, 52)
#: Distance of the marks that show how far the robot has moved, and of the larger ones, m.
MARK, LANDMARK = 0.1, 0.5
MUSCLES = SCALES["muscle"].palette()
#: Width of the cells in which the surface of a body is computed, m, and the most that a picture has in a row.
CELL, MOST_CELLS = 1e-3, 1024
#: Matter is drawn as one piece where its particles act on each other: up to 3 nodes apart they still share one, m.
BRIDGE = 3 / NODES
#: Standard deviations of the filters that smooth a surface and its colours, cells.
SMOOTH_EDGE, SMOOTH_COLOUR = 2.5, 3.0
#: Bits behind the point of the coordinates of polygons, which OpenCV takes as integers.
SHIFT = 4


def frame(
    scene: Scene,
    shot: Shot,
    size: int = 512,
    zoom: float | None = None,
    muscles: bool = True,
    caption: tuple[str, str] | None = None,
    legend: bool = False,
) -> np.ndarray:
    """Draw one moment, (size, size, 3) uint8 RGB; options as in :meth:`dittogym.render.recording.Recording.picture`."""
    width = check_view(size, zoom)
    checks.flag("muscles", muscles)
    canvas = Canvas(size, shot.corner(width), width)
    marks = canvas.marks()
    canvas.target(scene.target, shot.centre)
    for solid in scene.solids:
        canvas.box(solid)
    canvas.ruler(marks)
    ends = np.cumsum([body.count for body in scene.bodies])
    for number, (end, body) in reversed(list(enumerate(zip(ends, scene.bodies, strict=True)))):  # the robot on top
        x, colours = shot.x[end - body.count : end], np.array(body.colour, np.uint8)
        if number == 0:
            if scene.goal is not None:
                canvas.goal(scene.goal)
            if muscles and "muscle" in shot.values:
                colours = MUSCLES[shot.values["muscle"]]
        if body.grains and number:
            canvas.surface(x, np.mean((body.colour, GROUND), 0), 3 * body.radius, body.radius, 0)
            canvas.grains(x, body.colour, 0.6 * body.radius)
        else:  # its outer particles lie half their distance below its surface
            canvas.surface(x, colours, max(body.radius, BRIDGE / 2), body.radius / (2 * RADIUS), max(1, size / 400))
    lines = 1 if caption is None else canvas.caption(*caption)
    if legend:
        entries = [("soil" if body.grains else "object", body.colour) for body in scene.bodies[1:]]
        entries += [("goal", TARGET)] if scene.goal is not None else []
        entries += [("target", TARGET)] if scene.target else []
        canvas.legend(entries, muscles, lines)
    return canvas.image


def pace(speed: float) -> str:
    """A playback speed in words; 1 is real time."""
    if speed == 1:
        return "real time"
    factor, word = (1 / speed, "slower") if speed < 1 else (speed, "faster")
    return f"{factor:.0f} times {word}" if factor >= 9.95 else f"{factor:.2g} times {word}"


def written_return(total: float) -> str:
    """A return as people read it, without a minus before a zero."""
    total = round(total, 1) + 0.0
    return f"{total:,.1f}" if abs(total) < 1000 else f"{total:,.0f}"


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
        self.font = max(12, pixels // 27)
        self.image = np.empty((pixels, pixels, 3), np.uint8)
        cv2.rectangle(self.image, (0, 0), (pixels, pixels), GROUND, cv2.FILLED)  # much faster than NumPy

    def place(self, points: np.ndarray) -> np.ndarray:
        """Column and row (..., 2) of points in the world, m."""
        return np.asarray((points - self.corner) * (self.scale, -self.scale) + (0, self.pixels))

    def marks(self) -> list[tuple[float, int]]:
        """Draw lines and bands at round positions; returns the position, m, and the column of each line."""
        self.stripes(LANDMARK, 0, BAND)
        left = float(self.corner[0])
        found = []
        for k in range(int(np.ceil(left / MARK)), int(np.floor((left + self.width) / MARK)) + 1):
            column = round((k * MARK - left) * self.scale)
            cv2.line(self.image, (column, 0), (column, self.pixels), GRID, 1)
            found.append((k * MARK, column))
        return found

    def stripes(self, width: float, top: int, colour: tuple[int, ...]) -> None:
        """Fill every second interval of a width, m, from a row on downwards, so that motion along the ground shows."""
        left = float(self.corner[0])
        for k in range(int(np.floor(left / width)), int(np.floor((left + self.width) / width)) + 1):
            if k % 2:
                ends = [round((end * width - left) * self.scale) for end in (k, k + 1)]
                cv2.rectangle(self.image, (ends[0], top), (ends[1] - 1, self.pixels), colour, cv2.FILLED)

    def ruler(self, marks: list[tuple[float, int]]) -> None:
        """Write the positions of lines at the bottom, as far as there is room for them."""
        font = self.font
        if MARK * self.scale < 3.5 * font:
            marks = [(x, column) for x, column in marks if round(x / MARK) % 5 == 0]
        written = -math.inf
        for x, column in marks:
            if 2 * font <= column <= self.pixels - 2 * font and column - written >= 3.5 * font:
                written = column
                dark = self.image[-font, column].mean() < 150
                colour = (240, 240, 240) if dark else SOLID
                self.text(f"{x + 0.0:.1f} m", (column, self.pixels - 3 * font // 2), colour, 0.5)

    def box(self, box: Solid) -> None:
        """A box, or only its outline; a floor has marks."""
        low, high = self.place(np.array(((box.left, box.bottom), (box.right, box.top))))
        (left, bottom), (right, top) = np.clip((low, high), -9, self.pixels + 9)
        corners = self._fixed(np.array(((left, bottom), (right, bottom), (right, top), (left, top))))
        if box.filled:
            cv2.fillConvexPoly(self.image, corners, SOLID, cv2.LINE_AA, SHIFT)
            if np.isinf(box[:3]).all():
                self.stripes(MARK, round(top), TILE)
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

    def surface(self, position: np.ndarray, colours: np.ndarray, radius: float, edge: float, outline: float) -> None:
        """A body with a smooth outline: the closing of its particles by discs, and what lies around them.

        Args:
            position: (N, 2) in the world, m; particles that are not finite or out of sight are left out.
            colours: One for all (3,), or (N, 3), which are smoothed.
            radius: Of the discs, m: gaps of twice this width are closed.
            edge: How far the body reaches beyond its outer particles, m.
            outline: Width of its outline, pixels.
        """
        size = max(CELL, self.width / MOST_CELLS)
        reach, zoom = radius / size, size * self.scale
        position = position.astype(np.float64)
        far = 2 * radius
        seen = ((position >= self.corner - far) & (position < self.corner + self.width + far)).all(1)  # false for NaN
        if not seen.any():
            return
        # Cells are fixed in the world, so that the outline does not tremble while the camera moves.
        cell = np.floor(position[seen] / size).astype(int)
        border = int(reach) + 4
        low = cell.min(0) - border
        column, row = (cell - low).T
        empty = np.full((row.max() + border + 1, column.max() + border + 1), 255, np.uint8)
        empty[row, column] = 0
        (left, bottom), (right, top) = self.place(np.stack((low, low + empty.shape[::-1])) * size)
        left, top = (math.floor(min(max(side, 0), self.pixels)) for side in (left, top))
        width, height = (math.ceil(min(side, self.pixels)) - start for side, start in ((right, left), (bottom, top)))
        if min(width, height) <= 0:
            return
        first = self.place((low + 0.5) * size) - (left + 0.5, top + 0.5)
        matrix = np.array(((zoom, 0, first[0]), (0, -zoom, first[1])))

        def resampled(cells: np.ndarray) -> np.ndarray:
            return cv2.warpAffine(cells, matrix, (width, height), borderMode=cv2.BORDER_REPLICATE)

        if colours.ndim == 1:
            distance = cv2.distanceTransform(empty, cv2.DIST_L2, 5)
            drawn = np.full((height, width, 3), colours, np.uint8)
        else:
            distance, nearest = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
            palette = np.zeros((len(row) + 1, 3), np.uint8)
            palette[nearest[row, column]] = colours[seen]
            drawn = resampled(cv2.GaussianBlur(palette[nearest], (0, 0), SMOOTH_COLOUR))
        covered = distance < reach
        inside = cv2.distanceTransform(covered.view(np.uint8), cv2.DIST_L2, 5)
        depth = np.where(covered, inside, np.float32(reach) - distance) - np.float32(reach - edge / size)
        depth = zoom * resampled(cv2.GaussianBlur(depth, (0, 0), SMOOTH_EDGE))  # below the surface, pixels
        part = self.image[top : top + height, left : left + width]
        rim = np.nonzero((depth > -0.5) & (depth < outline + 0.5))
        below, under = part[rim], depth[rim][:, None]
        shade = 0.75 * np.clip(outline + 0.5 - under, 0, 1) * (outline > 0)
        outlined = drawn[rim] + shade * (np.array(OUTLINE, np.float32) - drawn[rim])
        cv2.copyTo(drawn, (depth > 0).view(np.uint8), part)
        part[rim] = below + np.clip(under + 0.5, 0, 1) * (outlined - below)

    def grains(self, position: np.ndarray, colour: tuple[int, ...], radius: float) -> None:
        """Filled circles of a radius in m at world positions (N, 2); only those that can be seen."""
        radius *= self.scale
        at = self.place(position.astype(np.float64))
        seen = ((at >= 0) & (at < self.pixels)).all(1)  # false where it is not finite
        if not seen.any():
            return
        empty = np.full(self.image.shape[:2], 255, np.uint8)
        column, row = at[seen].astype(int).T
        empty[row, column] = 0
        distance = cv2.distanceTransform(empty, cv2.DIST_L2, 5)
        self.image[distance <= radius - 0.5] = colour
        edge = np.nonzero(np.abs(distance - radius) < 0.5)
        cover = (radius + 0.5 - distance[edge])[:, None]
        self.image[edge] = self.image[edge] + cover * (np.array(colour, np.float32) - self.image[edge])

    def caption(self, left: str, right: str) -> int:
        """Write into both upper corners, on a light strip; where they are too close, one below the other.

        Returns the number of lines.
        """
        font = self.font
        end = self.text(left, (font // 2, self.strip(0)), INK, 0.0)
        if end + font + _text_mask(right, font).shape[1] <= self.pixels - font // 2:
            self.text(right, (self.pixels - font // 2, font // 6), INK, 1.0)
            return 1
        self.text(right, (font // 2, self.strip(1)), INK, 0.0)
        return 2

    def legend(self, entries: Sequence[tuple[str, tuple[int, ...]]], muscles: bool, line: int = 1) -> None:
        """Colours and what they mean, on a strip below those of the caption, if the picture has room for it."""
        if self.pixels < 20 * self.font:
            return
        font, row = self.font, self.strip(line)
        column = font // 2
        if muscles:
            ramp = cv2.resize(MUSCLES[None], (5 * font, font // 2), interpolation=cv2.INTER_LINEAR)
            column = self.text("expands", (column, row), INK, 0.0) + font // 2
            self.image[row + font // 3 : row + font // 3 + ramp.shape[0], column : column + ramp.shape[1]] = ramp
            self.text("contracts", (column + 11 * font // 2, row), INK, 0.0)
        column = self.pixels - font // 2
        for name, colour in reversed(entries):
            column = self.text(name, (column, row), INK, 1.0) - font // 2
            middle = (column - font // 4, row + 7 * font // 12)
            cv2.circle(self.image, middle, font // 3, colour, cv2.FILLED, cv2.LINE_AA)
            column -= 3 * font // 2

    def strip(self, number: int) -> int:
        """Lighten a line of the picture for text; returns the row where the text begins."""
        height = 4 * self.font // 3
        part = self.image[number * height : (number + 1) * height]
        if part.size:  # the smallest pictures have no second line
            part[:] = cv2.addWeighted(part, 0.2, np.full_like(part, 255), 0.8, 0)
        return number * height + self.font // 6

    def text(self, text: str, at: tuple[int, int], colour: tuple[int, ...], align: float) -> int:
        """Write at a column and a row, the top of the line; ``align`` 0: to the right of it, 1: to the left of it.

        Returns the column at the text's other end.
        """
        mask = _text_mask(text, self.font)
        width = mask.shape[1]
        column, row = round(at[0] - align * width), at[1]
        mask = mask[: max(0, self.pixels - row), max(0, -column) : max(0, self.pixels - column)]
        part = self.image[row : row + mask.shape[0], max(0, column) : max(0, column) + mask.shape[1]]
        part[:] = mask * np.array(colour) + (1 - mask) * part
        return column if align else column + width

    def _near(self, middle: np.ndarray) -> bool:
        """Whether a figure around here may be seen; OpenCV cannot be given numbers of any size."""
        return bool((np.abs(middle) < 4 * self.pixels).all())

    @staticmethod
    def _fixed(points: np.ndarray) -> np.ndarray:
        """Coordinates as OpenCV takes them; it counts from the middle of the first pixel."""
        return np.asarray(np.round((points - 0.5) * 2**SHIFT).astype(np.int32))


@functools.lru_cache(maxsize=512)
def _text_mask(text: str, size: int) -> np.ndarray:
    """A line of text, (H, W, 1) from 0 to 1: drawn larger, because letters of few pixels have whole distances."""
    large = 4
    font = ImageFont.load_default(large * size)
    left, _, right, bottom = font.getbbox(text)
    image = Image.new("L", (int(right - left) + large, int(bottom) + large))
    ImageDraw.Draw(image).text((-left, 0), text, 255, font)
    small = image.resize((-(-image.width // large), -(-image.height // large)), Image.Resampling.BOX)
    return np.asarray(small, np.float32)[..., None] / 255
