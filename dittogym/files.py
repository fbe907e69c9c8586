"""Writing files so that a program that is killed meanwhile leaves the old file or the new one, whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside ``path``, with its suffix, to write to; it takes its place at the end, and after an error goes.

    Others may write the same file meanwhile: the last one that ends replaces the rest.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.stem}.{uuid4().hex[:8]}.part{path.suffix}")
    try:
        aside.touch()  # names the file where it cannot be written; what ffmpeg says is a page long
        yield aside
        os.replace(aside, path)
    except BaseException:  # a simulation that fails, a second Ctrl-C
        aside.unlink(missing_ok=True)
        raise
