"""Reads drawings from image files, arrays and outlines."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
from PIL import Image, ImageOps

#: Pixels of the largest picture that is read from a file, 2048 x 2048: a body drawn in one may take 240 bytes for each.
LARGEST = 2**22
#: Pixels from this alpha or brightness on belong to a drawing.
OPAQUE = 128
#: Pictures whose brightness varies less than this have no drawing, all belongs to it or nothing.
CONTRAST = 32
#: Pixels along the longer side of an outline.
OUTLINE_PIXELS = 512
#: The path of an image file, an array (picture), or (K, 2) corners (outline).
DrawingLike: TypeAlias = "str | os.PathLike[str] | np.ndarray | Sequence[tuple[float, float]]"


def read_mask(drawing: DrawingLike, name: str, others: str) -> np.ndarray:
    """What is drawn in a picture, or what an outline encloses, (H, W) bool, row 0 at the top.

    In a picture with transparent pixels it is what is not transparent; else what is bright, or, where all four corners
    are bright, what is dark. Bool arrays are taken as they are. Colours may come in any order, RGB or BGR. An outline
    is a sequence of corners (x, y), x to the right and y upwards, in any unit.
    """
    if isinstance(drawing, list | tuple | np.ndarray):
        try:
            drawing = np.asarray(drawing)
        except ValueError as error:
            raise ValueError(f"{name} must be {others}an outline, an array or a path, got rows that differ") from error
        if drawing.shape[1:] == (2,) and drawing.dtype.kind in "fiu":
            return _enclosed(drawing.astype(np.float64), name)
    image = _read(drawing, name, others)
    if image.ndim == 3 and image.shape[2] == 4 and (image[..., 3] < OPAQUE).any():
        return np.asarray(image[..., 3] >= OPAQUE)
    grey = image if image.ndim == 2 else _brightness(image[..., :3])
    threshold = OPAQUE - 1.0
    if int(grey.max()) - int(grey.min()) >= CONTRAST:
        threshold, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_OTSU)
    mask = np.asarray(grey > threshold)
    on_bright = mask[[0, 0, -1, -1], [0, -1, 0, -1]].all() and not mask.all()
    return ~mask if on_bright and np.asarray(drawing).dtype != bool else mask


def _enclosed(corners: np.ndarray, name: str) -> np.ndarray:
    """The inside of an outline with corners (K, 2)."""
    if len(corners) < 3 or not np.isfinite(corners).all():
        raise ValueError(f"{name} must have at least 3 finite corners, got {corners.tolist()}")
    size = np.ptp(corners, axis=0).max()
    pixels = (corners - corners.min(0)) * (OUTLINE_PIXELS / size if size > 0 else 1.0)
    height, width = np.ceil(pixels.max(0)).astype(int)[::-1] + 1
    image, outline = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    path = [np.round(pixels).astype(np.int32)]
    cv2.fillPoly(image, path, 1)
    cv2.polylines(outline, path, isClosed=True, color=1)
    if not (image > outline).any():
        raise ValueError(f"{name} must have corners that enclose an area, got {corners.tolist()}")
    return np.flipud(image).astype(bool)


def _brightness(colours: np.ndarray) -> np.ndarray:
    """One number (H, W) uint8 for each pixel (H, W, 3), whatever the order of the channels.

    That of the brightest (red on black) or of the darkest channel (red on white), whichever tells more apart; or if
    neither does, as for red on green, how much a pixel differs from the upper left corner.
    """
    extreme = max((colours.max(-1), colours.min(-1)), key=_separation)
    difference = np.abs(colours - colours[0, 0].astype(np.int16)).max(-1).astype(np.uint8)
    return next((each for each in (extreme, difference) if np.ptp(each) >= CONTRAST), extreme)


def _separation(grey: np.ndarray) -> float:
    """The variance between the two groups of pixels that Otsu's threshold makes, which it makes as large as it can."""
    bright = cv2.threshold(grey, 0, 255, cv2.THRESH_OTSU)[1] > 0
    if bright.all() or not bright.any():
        return 0.0
    return float(bright.mean() * (~bright).mean() * (grey[bright].mean() - grey[~bright].mean()) ** 2)


def _read(picture: DrawingLike, name: str, others: str) -> np.ndarray:
    """A picture as uint8 (H, W), (H, W, 3) or (H, W, 4)."""
    if isinstance(picture, np.ndarray):
        return _as_bytes(picture, name)
    if not isinstance(picture, (str, os.PathLike)):
        raise ValueError(f"{name} must be {others}an outline, an array or a path, got {type(picture).__name__}")
    path = os.fspath(picture)
    if not os.path.isfile(path):
        given = f"no such file: {path!r}"
        raise ValueError(f"{name} must be {others}an outline, an array or the path of an image; {given}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own about large pictures; there is a limit of ours
            with Image.open(path) as image:
                size = image.size
                decoded = _decoded(image) if size[0] * size[1] <= LARGEST else None
    except Exception as error:  # decoders of damaged files raise whatever comes to hand
        raise ValueError(f"{name} {path!r} cannot be read as an image ({error})") from error
    if decoded is None:
        raise ValueError(f"{name} {path!r} must have at most {LARGEST} pixels, got {size[0]} x {size[1]}")
    return _as_bytes(decoded, name)


def _decoded(image: Image.Image) -> np.ndarray:
    """Grey values of 16 bits as they are, all else as RGB or RGBA, turned as its EXIF orientation says."""
    turned = ImageOps.exif_transpose(image)
    if turned.mode.startswith("I"):
        return np.asarray(turned).astype(np.uint16)
    return np.asarray(turned.convert("RGBA" if turned.has_transparency_data else "RGB"))


def _as_bytes(image: np.ndarray, name: str) -> np.ndarray:
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (3, 4)) or 0 in image.shape:
        raise ValueError(f"{name} array must have shape (H, W), (H, W, 3) or (H, W, 4), got {image.shape}")
    if image.dtype == bool:
        image = image * np.uint8(255)
    elif np.issubdtype(image.dtype, np.floating):
        if not np.isfinite(image).all() or image.min() < 0 or image.max() > 1:
            raise ValueError(f"{name} array of floating point numbers must lie in [0, 1]")
        image = np.round(image * 255).astype(np.uint8)
    elif image.dtype == np.uint16:
        image = (image // 257).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise ValueError(f"{name} array must be bool, uint8, uint16 or floating point, got {image.dtype}")
    return image
