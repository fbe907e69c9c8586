"""A lock on the folder of a run, so that one process at a time trains in it."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from cfp.errors import CFPError


class FolderInUse(CFPError):
    """Another process holds the folder."""


@contextmanager
def run_lock(folder: Path, timeout: float = 0.0) -> Iterator[None]:
    """Hold the folder of a run, which is created if need be; the system releases it however the process ends.

    Raises:
        FolderInUse: It is still held by another process after ``timeout`` seconds.
        OSError: The folder cannot be written.
    """
    is_new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / ".lock"
    try:
        lock = FileLock(path).acquire(timeout=timeout)
    except Timeout:
        owner = path.read_text().strip() if path.exists() else ""
        raise FolderInUse(f"out: {folder} is in use by {owner or 'another process'}") from None
    try:
        with lock:
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
    finally:
        if is_new:
            with suppress(OSError):  # something is in it
                folder.rmdir()
