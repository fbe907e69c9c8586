"""A folder belongs to one process at a time."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from cfp.errors import CFPError

NAME = ".lock"
POLL = 0.5
"""Seconds between two attempts."""


class Claimed(CFPError):
    """Another process holds the folder."""


@contextmanager
def claim(folder: Path, patience: float = 0.0) -> Iterator[None]:
    """Hold a folder, which is created if it is not there.

    The system gives the lock back when the process ends, however it ends: nothing has to be cleaned up after a crash.
    On a shared file system this holds between machines too if that knows ``flock`` (NFS 4, Lustre with ``-o flock``);
    what a lost machine held is free once the file server has given up on it.

    Args:
        folder: Of a run.
        patience: Seconds to wait for another process.

    Raises:
        Claimed: It is still held by another process.
        OSError: The folder cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # Windows has no flock
        yield
        return
    new = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path, end = folder / NAME, time.monotonic() + patience
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.fstat(file).st_ino == path.stat().st_ino:
                break  # else its last owner removed it between the two calls
        except BlockingIOError:
            if time.monotonic() >= end:
                owner = path.read_text().strip() if path.exists() else ""
                os.close(file)
                raise Claimed(f"out: {folder} is in use by {owner or 'another process'}") from None
            time.sleep(POLL)
        os.close(file)
    try:
        os.ftruncate(file, 0)
        os.write(file, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(file)
        if new:
            with suppress(OSError):  # something is in it
                folder.rmdir()
