"""A lock on the folder of a run, so that one process at a time trains in it."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from cfp.errors import CFPError
from cfp.experiment.folder import make_folder


class FolderInUse(CFPError):
    """Another process holds the folder."""


@contextmanager
def run_lock(folder: Path, timeout: float = 0.0) -> Iterator[None]:
    """Hold the folder of a run, which is created if need be; the system releases it however the process ends."""
    is_new = not folder.exists()
    make_folder(folder)
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
