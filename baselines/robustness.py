"""``torchmpm robustness``: `cfp.robustness` for policies of any algorithm."""

import sys
from collections.abc import Sequence

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp import robustness


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return robustness.main(arguments, "baselines.robustness")


if __name__ == "__main__":
    sys.exit(main())
