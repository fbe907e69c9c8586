"""Draws a fish in many ways, reads each file as a target of SHAPE MATCH, and writes a table of what became of it."""

from __future__ import annotations

import math
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from result_tables import markdown
from task_pages import PAGES, write

from dittogym.render.frame import GROUND, TARGET
from dittogym.tasks.targets import load_target

#: Pixels per side of a shown picture.
SHOWN = 96
#: Corners of the tail and centre of the eye, in half lengths of the fish.
TAIL, EYE = ((-0.55, 0.0), (-1.0, -0.5), (-1.0, 0.5)), (0.4, -0.1)


def fish(
    width: int = 400,
    height: int = 400,
    length: float = 0.8,
    centre: tuple[float, float] = (0.5, 0.5),
    eye: float = 0.0,
    line: int = cv2.FILLED,
) -> np.ndarray:
    """A fish, (height, width) bool.

    Args:
        width: Pixels.
        height: Pixels.
        length: Of the fish, as a share of the width.
        centre: As shares of width and height.
        eye: Radius of a hole, as a share of half the fish's length.
        line: Width of its outline in pixels; filled by default.
    """
    angles = np.linspace(0, 2 * math.pi, 200)
    body = np.stack((0.2 + 0.8 * np.cos(angles), 0.5 * np.sin(angles)), 1)
    half, middle = length * width / 2, np.array(centre) * (width, height)
    outlines = [np.round(middle + half * np.array(points)).astype(np.int32) for points in (body, TAIL)]
    image = np.zeros((height, width), np.uint8)
    for outline in outlines:
        if line == cv2.FILLED:
            cv2.fillPoly(image, [outline], 1)
        else:
            cv2.polylines(image, [outline], isClosed=True, color=1, thickness=line)
    if eye:
        cv2.circle(
            image, np.round(middle + half * np.array(EYE)).astype(int).tolist(), round(eye * half), 0, cv2.FILLED
        )
    return image.astype(bool)


def black_on_white(mask: np.ndarray) -> np.ndarray:
    """The drawing (H, W) uint8."""
    return np.where(mask, 0, 255).astype(np.uint8)


def photograph(mask: np.ndarray) -> np.ndarray:
    """A blurred, noisy picture (H, W, 3) uint8 of something orange on a table that is lit from one side."""
    light = np.linspace(1.0, 0.7, mask.shape[1])[None, :, None]
    colours = np.where(mask[..., None], (30, 90, 170), (215, 220, 225)) * light  # blue, green, red
    colours += np.random.default_rng(0).normal(0, 12, colours.shape)
    return cv2.GaussianBlur(colours.clip(0, 255).astype(np.uint8), (9, 9), 0)


def transparent(mask: np.ndarray) -> np.ndarray:
    """White on nothing, (H, W, 4) uint8."""
    return np.dstack([np.full((*mask.shape, 3), 255, np.uint8), 255 * mask.astype(np.uint8)])


#: Name, suffix of the file, what is drawn, and the picture of it.
DRAWINGS: dict[str, tuple[str, np.ndarray, Callable[[np.ndarray], np.ndarray]]] = {
    "black on white, 400 × 400": (".png", fish(), black_on_white),
    "white on a transparent ground": (".png", fish(), transparent),
    "grey on light grey": (".png", fish(), lambda mask: np.where(mask, 150, 220).astype(np.uint8)),
    "tiny, 24 × 24": (".png", fish(24, 24), black_on_white),
    "huge, 2000 × 2000": (".png", fish(2000, 2000), black_on_white),
    "small, in a corner of 600 × 400": (".png", fish(600, 400, 0.2, (0.2, 0.75)), black_on_white),
    "with a hole": (".png", fish(eye=0.16), black_on_white),
    "JPEG of low quality": (".jpg", fish(), lambda mask: np.where(mask[..., None], (170, 90, 30), (235, 240, 245))),
    "like a photograph, in JPEG": (".jpg", fish(), photograph),
    "only an outline": (".png", fish(line=6), black_on_white),
}


def become(path: Path) -> tuple[np.ndarray, list[str]]:
    """The target that a file becomes, and the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return load_target(path), [str(warning.message) for warning in caught]


def pair(picture: np.ndarray, target: np.ndarray) -> np.ndarray:
    """A drawing and its target beside each other, (SHOWN, 2 * SHOWN + 8, 3) uint8, blue first."""
    if picture.ndim == 2:
        picture = np.dstack([picture] * 3)
    if picture.shape[2] == 4:  # squares, as image editors show transparency
        squares = np.where((np.indices(picture.shape[:2]) // 25).sum(0) % 2, 205, 235)[..., None]
        picture = np.where(picture[..., 3:] > 0, picture[..., :3], squares)
    height, width = picture.shape[:2]
    scale = SHOWN / max(height, width)
    small = cv2.resize(
        picture.astype(np.uint8), (round(scale * width), round(scale * height)), interpolation=cv2.INTER_AREA
    )
    both = np.full((SHOWN, 2 * SHOWN + 8, 3), 255, np.uint8)
    top = (SHOWN - small.shape[0]) // 2
    both[top : top + small.shape[0], : small.shape[1]] = small
    shown = np.where(target[..., None], TARGET[::-1], GROUND[::-1]).astype(np.uint8)
    both[:, -SHOWN:] = cv2.resize(shown, (SHOWN, SHOWN), interpolation=cv2.INTER_NEAREST)
    return both


def write_drawings() -> None:
    """Write `targets.md` and its pictures into the folder of the generated pages."""
    folder = PAGES / "targets"
    folder.mkdir(parents=True, exist_ok=True)
    rows, clean = [], load_target(fish())
    with tempfile.TemporaryDirectory() as temporary:
        for number, (name, (suffix, mask, draw)) in enumerate(DRAWINGS.items()):
            path, picture = Path(temporary, f"fish{suffix}"), draw(mask).astype(np.uint8)
            cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, 30] if suffix == ".jpg" else [])
            target, remarks = become(path)
            cv2.imwrite(str(folder / f"{number}.png"), pair(picture, target))
            overlap = (target & clean).sum() / (target | clean).sum()
            result = f"warning: {' '.join(remarks)}" if remarks else f"{target.sum()} pixels, overlap {overlap:.2f}"
            rows.append([name, f"![{name}](generated/targets/{number}.png)", result])
        path = Path(temporary, "fish.svg")
        path.write_text('<svg xmlns="http://www.w3.org/2000/svg"/>')
        try:
            load_target(path)
        except ValueError as error:
            rows.append(["a vector drawing (SVG)", "", f"error: {str(error).replace(str(path), path.name)}"])
    write(PAGES / "targets.md", markdown(("Drawing", "File, and target", "Result"), rows))
