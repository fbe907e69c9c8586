"""Custom robots: a picture, an outline or any shape in the place of a task's robot."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np

from dittogym.bodies.images import PictureLike, read_mask
from dittogym.bodies.shapes import Figure, Shape
from dittogym.spec import BodySpec, TaskSpec

#: A path or an array (picture), (K, 2) corners (outline), a shape, or a body.
BodyLike: TypeAlias = "PictureLike | Sequence[tuple[float, float]] | Shape | BodySpec"

#: Pixels along the longer side of an outline.
OUTLINE_PIXELS = 512
#: Parts of a drawing that count as parts, as a fraction of its area.
SMALLEST_PART = 0.02


def with_body(spec: TaskSpec, body: BodyLike) -> TaskSpec:
    """The task with another robot.

    Pictures and outlines keep the area, particles and mass of the task's own robot, and stand where it stood: same
    centre in x, same lowest point. With thicker lines they take less room. A shape lies where it says, and is filled as
    densely: a picture of another size is a :class:`dittogym.bodies.shapes.Figure`. A body is taken as it is.

    Args:
        spec: The task.
        body: The path of an image or an array (H, W), (H, W, 3), (H, W, 4), read by
            :func:`dittogym.bodies.images.read_mask`; corners (K, 2) of an outline with x to the right and y upwards, in
            any unit; a shape of :mod:`dittogym.bodies.shapes` in world coordinates; or a
            :class:`dittogym.spec.BodySpec`.

    Raises:
        ValueError: Not readable as one of these, or empty.
    """
    own = spec.robot
    if isinstance(body, Shape):
        body = replace(own, shape=body, count=max(1, round(own.count * body.area / own.shape.area)))
    elif not isinstance(body, BodySpec):
        body = replace(own, shape=_figure(body, own.shape))
    return replace(spec, robot=body)


def _figure(body: PictureLike | Sequence[tuple[float, float]], own: Shape) -> Figure:
    """A picture or an outline with the area and in the place of another shape."""
    mask = _mask(body)
    areas = cv2.connectedComponentsWithStats(mask.astype(np.uint8))[2][1:, cv2.CC_STAT_AREA]
    if (parts := int((areas >= SMALLEST_PART * mask.sum()).sum())) > 1:
        warnings.warn(f"the robot falls apart from the start: its drawing has {parts} separate parts", stacklevel=4)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    mask = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    pixel = math.sqrt(own.area / mask.sum())
    left = own.corner[0] + 0.5 * (own.size[0] - mask.shape[1] * pixel)
    return Figure(mask, (left, own.corner[1]), pixel)


def _mask(body: PictureLike | Sequence[tuple[float, float]]) -> np.ndarray:
    if not isinstance(body, (str, os.PathLike)):
        try:
            body = np.atleast_2d(np.asarray(body))
        except ValueError as error:  # rows of different lengths
            raise ValueError(f"body must be a path, an array, a Shape or a BodySpec, got {body!r}") from error
        if body.shape[1:] == (2,) and body.dtype.kind in "fiu":
            return _filled(body.astype(np.float64))
    mask = read_mask(body, "body", others="an outline (K, 2), ")
    if not mask.any():
        raise ValueError("body must be a picture in which something is drawn, got an empty one")
    return mask


def _filled(corners: np.ndarray) -> np.ndarray:
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"body must have at least 3 finite corners, got {corners.tolist()}")
    size = np.ptp(corners, axis=0).max()
    pixels = (corners - corners.min(0)) * (OUTLINE_PIXELS / size if size > 0 else 1.0)
    height, width = np.ceil(pixels.max(0)).astype(int)[::-1] + 1
    image, outline = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    path = [np.round(pixels).astype(np.int32)]
    cv2.fillPoly(image, path, 1)
    cv2.polylines(outline, path, isClosed=True, color=1)
    if not (image > outline).any():
        raise ValueError(f"body must have corners that enclose an area, got {corners.tolist()}")
    return np.flipud(image).astype(bool)
