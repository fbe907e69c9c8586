"""``python -m baselines.robustness RUN_FOLDER``: `cfp.robustness` for a policy of any algorithm."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from baselines.train import PROGRAM
from cfp import robustness


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return robustness.main(arguments, PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
