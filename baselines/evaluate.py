"""``python -m baselines.evaluate RUN_FOLDER``: how good is a policy of any algorithm, those of `cfp` included."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from baselines.train import PROGRAM
from cfp import evaluate


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return evaluate.main(arguments, PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
