"""``torchmpm distill``: a policy of images learns from one that sees more; the same as ``--algo distill``."""

import sys
from collections.abc import Sequence

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp import train


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return train.main(arguments, "baselines.distill", ("--algo", "distill"))


if __name__ == "__main__":
    sys.exit(main())
