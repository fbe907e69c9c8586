"""Pictures from files and arrays as grey values."""

from __future__ import annotations

import os
import warnings
from typing import TypeAlias

import cv2
import numpy as np
from PIL import Image

#: Pixels of the largest picture that is read from a file, 2048 x 2048: a body drawn in one may take 240 bytes for each.
LARGEST = 2**22
#: The path of an image file, or an array.
PictureLike: TypeAlias = "str | os.PathLike[str] | np.ndarray"


def read_grey(picture: PictureLike, name: str, others: str) -> np.ndarray:
    """A picture as grey values (H, W) uint8, row 0 at the top; what is transparent is black."""
    if isinstance(picture, np.ndarray):
        return _grey(picture, name)
    if not isinstance(picture, (str, os.PathLike)):
        raise ValueError(f"{name} must be {others}an array or a path, got {type(picture).__name__}")
    path = os.fspath(picture)
    if not os.path.isfile(path):
        raise ValueError(f"{name} must be {others}an array or the path of an image; no such file: {path!r}")
    try:
        width, height = _claimed_size(path)
        small = width * height <= LARGEST
        image = cv2.imread(path, cv2.IMREAD_UNCHANGED) if small else None
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, cv2.error) as error:
        raise ValueError(f"{name} {path!r} cannot be read as an image ({error})") from error
    if not small:
        raise ValueError(f"{name} {path!r} must have at most {LARGEST} pixels, got {width} x {height}")
    if image is None:
        raise ValueError(f"{name} {path!r} cannot be read as an image")
    return _grey(image, name)


def _claimed_size(path: str) -> tuple[int, int]:
    """Width and height from the head of a file: a few bytes may claim to be what fills the memory."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own about large pictures; there is a limit of ours
        with Image.open(path) as image:
            size = image.size
            image.verify()  # OpenCV takes memory for whatever length a chunk of a PNG claims
            return size


def _grey(image: np.ndarray, name: str) -> np.ndarray:
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
    if image.ndim == 2:
        return image
    grey = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2GRAY)
    return grey if image.shape[2] == 3 else (grey.astype(np.uint16) * image[..., 3] // 255).astype(np.uint8)
