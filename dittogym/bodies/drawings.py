"""Custom robots: a picture, an outline or any shape in the place of a task's robot."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np

from dittogym.bodies.images import DrawingLike, read_mask
from dittogym.bodies.shapes import Figure, Shape
from dittogym.spec import BodySpec, TaskSpec

#: A drawing, a shape, or a body.
BodyLike: TypeAlias = "DrawingLike | Shape | BodySpec"

#: Parts of a drawing that count as parts, as a fraction of its area.
SMALLEST_PART = 0.02


def with_body(spec: TaskSpec, body: BodyLike) -> TaskSpec:
    """Return a task with another robot, as the option ``body`` of environments does.

    A picture or an outline is scaled to the area of the task's own robot, has as many particles and as much mass, and
    is put in its place, with the same centre in x and the same lowest point. If it does not fit there, draw it with
    thicker lines, with which it takes less room.

    What is drawn in a picture are its opaque pixels if there are transparent ones; otherwise its bright pixels, or, if
    all four corners are bright, its dark ones. In a Boolean array, true pixels are drawn. The order of the colours, RGB
    or BGR, does not matter.

    Args:
        spec: The task.
        body: A picture, as the path of an image file or as an array (H, W), (H, W, 3) or (H, W, 4) of bool, uint8,
            uint16, or floating point from 0 to 1; an outline, as corners (K, 2) with x to the right and y upwards, in
            any unit; a shape of :mod:`dittogym.bodies.shapes`, which stays where it is, in metres, and is filled as
            densely as the task's own robot; or a :class:`dittogym.spec.BodySpec`, which is taken as it is. A picture
            that is to keep its size is a :class:`dittogym.bodies.shapes.Figure`.

    Returns:
        A specification with ``body`` as its robot. It warns if a drawing consists of separate parts.

    Raises:
        ValueError: ``body`` is nothing of these, cannot be read, or is empty.
    """
    own = spec.robot
    if isinstance(body, Shape):
        body = replace(own, shape=body, count=max(1, round(own.count * body.area / own.shape.area)))
    elif not isinstance(body, BodySpec):
        body = replace(own, shape=_figure(body, own.shape))
    return replace(spec, robot=body)


def _figure(body: DrawingLike, own: Shape) -> Figure:
    """A picture or an outline with the area and in the place of another shape."""
    mask = read_mask(body, "body", "a Shape, a BodySpec, ")
    if not mask.any():
        raise ValueError("body must be a picture in which something is drawn, got an empty one")
    areas = cv2.connectedComponentsWithStats(mask.astype(np.uint8))[2][1:, cv2.CC_STAT_AREA]
    if (parts := int((areas >= SMALLEST_PART * mask.sum()).sum())) > 1:
        warnings.warn(f"the robot falls apart from the start: its drawing has {parts} separate parts", stacklevel=4)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    mask = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    pixel = math.sqrt(own.area / mask.sum())
    left = own.corner[0] + 0.5 * (own.size[0] - mask.shape[1] * pixel)
    return Figure(mask, (left, own.corner[1]), pixel)
