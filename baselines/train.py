"""``torchmpm train --algo NAME``: train any algorithm, watch it, stop it, resume it."""

import sys
from collections.abc import Sequence

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp import train


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return train.main(arguments, "baselines.train")


if __name__ == "__main__":
    sys.exit(main())
