"""``torchmpm train --algo NAME``: train any algorithm, watch it, stop it, resume it."""

import sys
from collections.abc import Sequence

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp import train


def main(arguments: Sequence[str] | None = None) -> int:
    """Train as the command ``torchmpm train`` does, also algorithms and tasks that this program registered.

    Args:
        arguments: Words of the command line, such as ``["--algo", "shac", "--task", "run"]``; None for those of the
            program.

    Returns:
        The exit code, 0 for success.
    """
    return train.main(arguments, "baselines.train")


if __name__ == "__main__":
    sys.exit(main())
