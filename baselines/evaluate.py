"""``torchmpm evaluate``: `cfp.evaluate` for policies of any algorithm."""

import sys
from collections.abc import Sequence

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp import evaluate


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return evaluate.main(arguments, "baselines.evaluate")


if __name__ == "__main__":
    sys.exit(main())
