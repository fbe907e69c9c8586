"""Pictures of a simulation as arrays; no window system, no files."""

from __future__ import annotations

import cv2
import numpy as np

from dittogym.render.canvas import Canvas
from dittogym.render.colours import SCALES
from dittogym.render.scene import Scene, Shot, check_view

MUSCLES = SCALES["muscle"].palette()


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
