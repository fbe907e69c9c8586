"""Progress bars on the standard error."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(**options: Any) -> tqdm[Any]:
    """A bar that writes fewer lines into a log file than onto a terminal; ``options`` are those of tqdm."""
    return tqdm(mininterval=0.1 if sys.stderr.isatty() else 15.0, **options)
