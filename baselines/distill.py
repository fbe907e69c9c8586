"""``python -m baselines.distill``: a policy of images learns from one that sees more; ``--algo distill`` by name."""

import sys
from collections.abc import Sequence
from dataclasses import replace

from baselines.train import PROGRAM
from cfp.experiment import training
from cfp.experiment.cli import program_name

TEACHING = replace(
    PROGRAM,
    about="Train the coarse-to-fine policy to imitate a teacher that may observe more, by dataset aggregation.",
    examples=("--task run --teacher shac --out runs/taught", "--task slot --teacher mpc --seed 1"),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    words = ["--algo", "distill", *(sys.argv[1:] if arguments is None else arguments)]
    return training.main(TEACHING, words, program_name("baselines.distill", arguments))


if __name__ == "__main__":
    sys.exit(main())
