"""``python -m baselines.distill``: a policy of images learns from one that sees more; ``--algo distill`` by name."""

import sys
from collections.abc import Sequence

from baselines.train import PROGRAM
from cfp.experiment import training
from cfp.experiment.cli import program_name


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    words = ["--algo", "distill", *(sys.argv[1:] if arguments is None else arguments)]
    return training.main(PROGRAM, words, program_name("baselines.distill", arguments))


if __name__ == "__main__":
    sys.exit(main())
