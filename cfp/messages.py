"""What a program says while it works: lines on the standard output, and progress bars on the standard error."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TextIO

from tqdm import tqdm

#: Seconds between two states of a bar that is not on a terminal, such as in a log file.
SELDOM = 15.0
_is_quiet: ContextVar[bool] = ContextVar("quiet", default=False)  # of a thread, so that trainings may run in several


@contextmanager
def quiet(on: bool = True) -> Iterator[None]:
    """Say nothing within the block, if ``on``."""
    token = _is_quiet.set(on or _is_quiet.get())
    try:
        yield
    finally:
        _is_quiet.reset(token)


def say(text: str, output: TextIO | None = None) -> None:
    """Print a line to ``output``, None: to the standard output."""
    if not _is_quiet.get():
        print(text, file=output)


def progress_bar(**options: Any) -> tqdm:
    """A progress bar with ``options`` of tqdm; one that is not on a terminal appears only if the work takes a while."""
    usual = {"unit": "step", "disable": _is_quiet.get() or sys.stderr is None}
    if not (hasattr(sys.stderr, "isatty") and sys.stderr.isatty()):
        usual |= {"mininterval": SELDOM, "delay": SELDOM, "position": 0}  # no cursor could move to another line
    return tqdm(**usual | options)
