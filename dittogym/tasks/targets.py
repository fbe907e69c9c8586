"""Pictures for SHAPE MATCH: four drawn here, or the user's own."""

from __future__ import annotations

import math
import warnings

import cv2
import numpy as np

from dittogym.bodies.images import DrawingLike, read_mask
from dittogym.observation import SIZE
from torchmpm import checks

#: Pixels that the robot of SHAPE MATCH covers at the start.
ROBOT_AREA = round(math.pi * 0.085**2 * (2 * SIZE) ** 2)
#: Areas of targets that a robot can take, as shares of that one: matter flows, but is neither made nor lost.
AREAS = (0.7, 1.3)
#: A centroid further than this from the middle is out of the robot's reach, pixels.
OFF_CENTRE = 3.0
#: Fitted drawings stay so many pixels away from the edge, and are drawn so many times larger first.
MARGIN, FINE = 3, 8
#: Parts of a target that count as parts, pixels; the largest share of thin lines without a warning.
SMALLEST_PART, LARGEST_THIN_SHARE = 8, 0.5

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


def load_target(target: DrawingLike, fit: bool = True) -> np.ndarray:
    """Read a target of SHAPE MATCH.

    Args:
        target: ``"star"``, ``"I"``, ``"M"`` or ``"T"``; or a picture or an outline, in the forms and with the rules of
            :func:`dittogym.bodies.drawings.with_body`.
        fit: Whether a drawing of another size or in another place is scaled to the robot's area and moved to the middle
            of the picture, where the robot's centre is. With False the picture is only resized as a whole.

    Returns:
        (64, 64) bool, row 0 at the top. A warning says why if no robot can be expected to match it.

    Raises:
        ValueError: ``target`` is neither a name nor a readable picture or outline, or no pixel or every pixel of it is
            drawn; or ``fit`` is not True or False.
    """
    checks.flag("fit", fit)
    if isinstance(target, str) and target in _OUTLINES:
        drawn: np.ndarray = np.zeros((SIZE, SIZE), np.uint8)
        for outline in _OUTLINES[target]:
            cv2.fillPoly(drawn, [np.array(outline)], 1)
        return drawn.astype(bool)
    picture = read_mask(target, "target", others="".join(f"{name!r}, " for name in _OUTLINES))
    mask = _reduced(picture)
    if fit and picture.any() and not picture.all() and not _fits(picture, mask):
        mask = _fitted(picture)
    if not mask.any() or mask.all():
        raise ValueError(f"target must have pixels of the shape and of the ground, got {mask.sum()} of {mask.size}")
    if reasons := _unmatchable_reasons(mask):
        warnings.warn(f"no robot can be expected to match the target: {'; '.join(reasons)}", stacklevel=2)
    return mask


def _reduced(mask: np.ndarray) -> np.ndarray:
    """A mask in (64, 64), where half of a pixel's area decides."""
    return np.asarray(cv2.resize(mask.astype(np.float32), (SIZE, SIZE), interpolation=cv2.INTER_AREA) >= 0.5)


def _offset(mask: np.ndarray) -> np.ndarray:
    """Rows and columns (2,) from the middle of a picture to the centre of what is drawn."""
    return np.asarray(np.argwhere(mask).mean(0) - (np.array(mask.shape) - 1) / 2)


def _fits(picture: np.ndarray, mask: np.ndarray) -> bool:
    """Whether a picture can stay as it is, with the result that a fitted one stays the same when it is loaded again."""
    if picture.shape[0] != picture.shape[1] or not mask.any():
        return False
    low, high = (share * ROBOT_AREA for share in AREAS)
    return bool(low <= mask.sum() <= high and np.abs(_offset(mask)).max() <= OFF_CENTRE)


def _fitted(picture: np.ndarray) -> np.ndarray:
    """A drawing scaled to the robot's area, as far as it stays inside, around the middle of (64, 64) pixels."""
    pixels = np.argwhere(picture)[:, ::-1]
    centre = pixels.mean(0)
    reach = np.abs(pixels - centre).max() + 0.5
    scale = FINE * min(np.sqrt(ROBOT_AREA / len(pixels)), (SIZE / 2 - MARGIN) / reach)
    move = np.array([[scale, 0, 0], [0, scale, 0]])
    move[:, 2] = FINE * SIZE / 2 - 0.5 - scale * centre
    drawn: np.ndarray = picture.astype(np.float32)
    if scale < 0.5:  # else thin lines would fall between the pixels that are looked at
        drawn = cv2.blur(drawn, (round(1 / scale),) * 2)
    return _reduced(cv2.warpAffine(drawn, move, (FINE * SIZE,) * 2, flags=cv2.INTER_LINEAR))


def _unmatchable_reasons(mask: np.ndarray) -> list[str]:
    """Why a robot is unlikely to take this shape."""
    reasons, area = [], int(mask.sum())
    low, high = (round(share * ROBOT_AREA) for share in AREAS)
    if not low <= area <= high:
        reasons.append(f"it has {area} pixels, and a robot that is whole covers {low} to {high}")
    if np.abs(offset := _offset(mask)).max() > OFF_CENTRE:
        reasons.append(f"its centre is {offset[0]:+.1f} rows and {offset[1]:+.1f} columns off the middle")
    _, _, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if (parts := int((statistics[1:, cv2.CC_STAT_AREA] >= SMALLEST_PART).sum())) > 1:
        reasons.append(f"it has {parts} separate parts")
    thick = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if (thin := 1 - thick.sum() / area) > LARGEST_THIN_SHARE:
        reasons.append(f"{thin:.0%} of it are lines thinner than 3 pixels")
    return reasons
