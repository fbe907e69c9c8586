"""Pictures for SHAPE MATCH: four drawn here, or the user's own."""

from __future__ import annotations

import warnings
from typing import TypeAlias

import cv2
import numpy as np

from dittogym.bodies.images import PictureLike, read_grey
from dittogym.observation.image import SIZE

#: The name of a drawn target, the path of an image file, or an array.
TargetLike: TypeAlias = PictureLike

#: Grey values from this on belong to the shape.
THRESHOLD = 125
#: A centroid further than this from the middle is worth a warning, pixels.
OFF_CENTRE = 3.0

# Corners (column, row) of filled polygons, several for a shape that is a union.
# fmt: off
_OUTLINES: dict[str, list[list[tuple[int, int]]]] = {
    "star": [[
        (30, 15), (32, 15), (36, 26), (44, 25), (45, 27), (38, 34), (43, 48), (40, 47),
        (31, 41), (23, 48), (22, 47), (26, 34), (19, 28), (18, 25), (26, 25),
    ]],
    "I": [
        [(15, 17), (46, 17), (46, 19), (15, 19)],
        [(26, 20), (34, 20), (34, 39), (26, 39)],
        [(15, 40), (46, 40), (46, 44), (15, 44)],
    ],
    "M": [
        [(15, 22), (20, 22), (20, 42), (15, 42)],
        [(45, 22), (50, 22), (50, 42), (45, 42)],
        [(21, 22), (32, 33), (33, 33), (44, 22), (44, 28), (33, 40), (32, 40), (21, 28)],
    ],
    "T": [[(15, 21), (48, 21), (48, 27), (15, 27)], [(28, 28), (35, 28), (35, 51), (28, 51)]],
}
# fmt: on


def load_target(target: TargetLike) -> np.ndarray:
    """A target as a (64, 64) bool array, row 0 at the top.

    Args:
        target: ``"star"``, ``"I"``, ``"M"``, ``"T"``, the path of an image, or an array (H, W), (H, W, 3) or (H, W, 4):
            bool, uint8 0..255, or floating point 0..1. Pictures of another size are resized to 64 x 64 by area; grey
            values from 125 of 255 belong to the shape.

    Raises:
        ValueError: Neither a name nor a readable image, an array of another kind, or a picture without any pixel set or
            unset.
    """
    if isinstance(target, str) and target in _OUTLINES:
        grey: np.ndarray = np.zeros((SIZE, SIZE), np.uint8)
        for outline in _OUTLINES[target]:
            cv2.fillPoly(grey, [np.array(outline)], 255)
    else:
        grey = read_grey(target, "target", others="".join(f"{name!r}, " for name in _OUTLINES))
        grey = cv2.resize(grey, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    mask = grey >= THRESHOLD
    if not mask.any() or mask.all():
        raise ValueError(f"target must have pixels of the shape and of the ground, got {mask.sum()} of {mask.size}")
    offset = np.argwhere(mask).mean(0) - (SIZE - 1) / 2
    if np.abs(offset).max() > OFF_CENTRE:
        where = f"{offset[0]:+.1f} rows and {offset[1]:+.1f} columns off the middle"
        warnings.warn(f"the target's centroid is {where}, where the robot's centre always is", stacklevel=2)
    return mask
