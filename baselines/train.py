"""``torchmpm train --algo NAME``: train any algorithm, watch it, stop it, resume it."""

import sys
from collections.abc import Sequence

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp.experiment import training


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return training.main(arguments, "baselines.train")


if __name__ == "__main__":
    sys.exit(main())
