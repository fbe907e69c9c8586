"""``python -m cfp.train``: train the coarse-to-fine policy, watch it, stop it, resume it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cfp.experiment import cli as command
from cfp.experiment.cfp_run import Runner
from cfp.presets import from_json
from cfp.weights import load

PROGRAM = command.Program(
    "cfp",
    "Train the coarse-to-fine policy on a DittoGym task: all levels of the ladder, one after the other.",
    from_json,
    Runner,
    load,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return command.main(PROGRAM, arguments)


if __name__ == "__main__":
    sys.exit(main())
