"""``python -m baselines.train --algo NAME``: train any algorithm, watch it, stop it, resume it."""

import sys
from collections.abc import Sequence

from baselines.registry import ALGORITHMS, algorithm_of, configure, load
from cfp.experiment import training

PROGRAM = training.Program(
    "baselines",
    f"Train an algorithm on a DittoGym task: {', '.join(ALGORITHMS)}. With --algo, this shows its options.",
    ("--algo shac --task run", "--algo gnn-16 --task kick --seed 1 --out runs/gnn", "--algo mpc --task run --dry-run"),
    configure,
    algorithm_of,
    load,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return training.main(PROGRAM, arguments)


if __name__ == "__main__":
    sys.exit(main())
