"""``python -m cfp.train``: train the coarse-to-fine policy, watch it, stop it, resume it."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cfp.analytic.config import AnalyticConfig
from cfp.analytic.learner import AnalyticLearner
from cfp.experiment import training
from cfp.experiment.sac_learner import SACLearner
from cfp.policy import load
from cfp.presets import from_json

PROGRAM = training.Program(
    "cfp",
    "Train the coarse-to-fine policy on a DittoGym task, one stage after the other.",
    (
        "--task run",
        "--task shapematch --target M --seed 1 --out runs/M",
        "--resume --out runs/M",
        "--task run --dry-run",
    ),
    from_json,
    lambda config: AnalyticLearner if isinstance(config, AnalyticConfig) else SACLearner,
    load,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return training.main(PROGRAM, arguments)


if __name__ == "__main__":
    sys.exit(main())
