"""Settings of the process that trains: stop signals and the allocator."""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
from types import FrameType
from typing import Any

_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1


def keep_memory() -> None:
    """Let glibc keep freed memory; fetching large tensors from the system anew makes an update a third slower."""
    if sys.platform != "linux":
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        # Before glibc 2.35 the threshold is at most 32 MiB. A threshold that was refused must not be followed by the
        # other setting, which would fix it at its small initial value.
        if any(library.mallopt(_M_MMAP_THRESHOLD, size) for size in (1 << 30, 1 << 25)):
            library.mallopt(_M_TRIM_THRESHOLD, (1 << 31) - 1)


def peak_memory() -> int | None:
    """Most bytes of memory that this process has held so far; None where the system does not tell (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest if sys.platform == "darwin" else 1024 * largest


class Stopped(Exception):
    """A signal asked the program to stop, and all work done so far has been saved."""

    def __init__(self, number: int, hint: str = "") -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}" + (f"; {hint}" if hint else ""))
        self.number = number


class StopSignals:
    """Lets training end its step after Ctrl-C or SIGTERM; the second one raises ``KeyboardInterrupt`` at once."""

    def __init__(self) -> None:
        self.number = 0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            raise KeyboardInterrupt
        self.number = number
        print(
            "\nstopping after this step, with a checkpoint (press Ctrl-C again to stop at once, without one)",
            file=sys.stderr,
        )
