"""Files that are whole: written in one move, and read only if their checksums are right."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

#: What `open_npz` raises for damaged files, besides ``OSError`` and ``EOFError``.
ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, NotImplementedError)


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


@contextmanager
def open_npz(path: str | os.PathLike[str]) -> Iterator[Mapping[str, Any]]:
    """The arrays of a file ``.npz``; a ``zipfile.BadZipFile`` if one is damaged. Nothing is unpickled.

    NumPy compares a checksum only where it reads an array to its end, which a damaged shape may prevent.
    """
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            raise zipfile.BadZipFile("it is no archive")  # NumPy would suggest to unpickle it
        file.seek(0)
        with np.load(file, allow_pickle=False) as archive:
            if (damaged := archive.zip.testzip()) is not None:
                raise zipfile.BadZipFile(f"{damaged} is damaged")
            yield archive
