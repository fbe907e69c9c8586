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
