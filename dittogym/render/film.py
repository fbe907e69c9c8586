"""Film files: MP4 (H.264, which every browser plays), GIF and WebP."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from dittogym.files import replacing

Frame = TypeVar("Frame")
#: The unit in which a format counts the time of a picture, s; a film has the nearest rate that is possible.
UNITS = {".gif": 0.01, ".webp": 0.001, ".mp4": None}


class VideoUnavailable(ImportError):
    """MP4 cannot be written: the extra ``video`` is not installed, or its ffmpeg fails."""


def check_available() -> None:
    """Raise `VideoUnavailable` unless the optional packages that write MP4 files are installed."""
    if not (find_spec("imageio") and find_spec("imageio_ffmpeg")):
        raise VideoUnavailable("MP4 needs imageio with ffmpeg: pip install 'torchmpm[video]'")


def possible_rate(suffix: str, rate: float) -> float:
    """The number of pictures per second that comes nearest to a rate in a format."""
    unit = UNITS[suffix]
    return rate if unit is None else 1.0 / (unit * max(1, round(1.0 / (unit * rate))))


def write_film(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    """Write one or more pictures, (H, W, 3) uint8, of which the last is shown a second longer.

    A file, with a suffix of :data:`UNITS`, is replaced only when all of it is written. The rate is that of
    :func:`possible_rate`, pictures per second.

    Raises:
        VideoUnavailable: MP4 without imageio and an ffmpeg with libx264.
    """
    with replacing(path) as aside:
        if path.suffix == ".mp4":
            _write_mp4(aside, frames, rate)
        else:
            pictures = _held(map(Image.fromarray, frames), round(rate))
            quality: Any = {"quality": 75, "method": 3} if path.suffix == ".webp" else {}
            first, duration = next(pictures), round(1000 / rate)
            first.save(aside, save_all=True, append_images=pictures, duration=duration, loop=0, **quality)


def _held(frames: Iterable[Frame], times: int) -> Iterator[Frame]:
    """The pictures, and the last one some more times."""
    for frame in frames:
        yield frame
    yield from itertools.repeat(frame, times)


def _write_mp4(path: Path, frames: Iterable[np.ndarray], rate: float) -> None:
    check_available()
    import imageio.v2 as imageio

    options: dict[str, Any] = {"codec": "libx264", "pixelformat": "yuv420p", "macro_block_size": 2, "quality": 8}
    writer: Any = imageio.get_writer(path, format="FFMPEG", fps=rate, **options)
    with closing(writer):  # its own `with` leaves ffmpeg running where there is an error
        for frame in _held(frames, round(rate)):
            with _named_failure():
                writer.append_data(frame)
    # It may have failed after the last picture, such as on a full disk, of which the writer tells nothing.
    with _named_failure():
        imageio.get_reader(path, format="FFMPEG").close()


@contextmanager
def _named_failure() -> Iterator[None]:
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = str(error).partition("\n")[0]  # a page follows
        raise VideoUnavailable(f"MP4 cannot be written: ffmpeg, which needs libx264, has failed ({reason})") from error
