"""Writing files so that a crash at any moment leaves either the old file or the new one, whole."""

from __future__ import annotations

import errno
import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

from cfp.errors import ConfigError

LARGEST_JSON = 2**20  # bytes


def write_atomically(path: Path, write: Callable[[BinaryIO], Any], shared: bool = False) -> None:
    """Write a file aside, flush it to disk, and move it into place; an error leaves the old file untouched.

    Args:
        path: The file.
        write: Writes its content.
        shared: Others may write it at the same time. Otherwise what a killed program has left of the file aside is
            overwritten.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f"{path.name}.{uuid4().hex[:8]}.part" if shared else f"{path.name}.part")
    aside.unlink(missing_ok=True)  # where it is a link, its target must not be written to
    try:
        with names_file(path), open(aside, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
    except BaseException:  # a full disk, on which every byte counts; Ctrl-C
        aside.unlink(missing_ok=True)
        raise
    os.replace(aside, path)
    _sync_folder(path.parent)


def check_output(option: str, path: Path) -> None:
    """Refuse a file that cannot be written before its content is computed; a `ConfigError` names the option."""
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ConfigError(f"{option}: {path} cannot be written ({error.strerror})") from error


@contextmanager
def names_file(path: Path) -> Iterator[None]:
    """Add the name of the file to an error of the system that lacks it, as that of a full disk does."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def _sync_folder(folder: Path) -> None:
    """Make a rename itself durable; some systems (Windows) cannot open a folder and need nothing here."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file of at most `LARGEST_JSON` bytes; ``OSError`` or ``ValueError`` if that fails."""
    if path.exists() and not path.is_file():
        raise OSError("it is not a file")  # a pipe or a device might never end
    with open(path, "rb") as file:
        content = file.read(LARGEST_JSON + 1)
    if len(content) > LARGEST_JSON:
        raise ValueError(f"it is larger than {LARGEST_JSON} bytes")
    value = parse_json(content.decode())
    if not isinstance(value, dict):
        raise ValueError(f"it must hold an object, got {type(value).__name__}")
    return value


def parse_json(text: str) -> Any:
    """Parse JSON; a ``ValueError`` where it is none."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def write_json(path: Path, value: Any, shared: bool = False) -> None:
    """Write JSON with an indent, see `write_atomically`."""
    write_text(path, json.dumps(value, indent=2) + "\n", shared)


def write_text(path: Path, text: str, shared: bool = False) -> None:
    """Write UTF-8 text, see `write_atomically`."""
    write_atomically(path, lambda file: file.write(text.encode()), shared)
