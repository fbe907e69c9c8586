"""Training from Python, whatever the algorithm: the same runs as those of the command line."""

from __future__ import annotations

import os
from typing import Any, ClassVar

from baselines.train import PROGRAM
from cfp import runs
from cfp.experiment.training import Program


class Run(runs.Run):
    """A run of any algorithm in its folder, with the members of `cfp.Run`.

    Args:
        folder: Where a training, from Python or from the command line, wrote it.

    Raises:
        CheckpointError: There is no run.
    """

    program: ClassVar[Program] = PROGRAM


def fit(
    algo: str,
    task: str,
    *,
    steps: int | None = None,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    **options: Any,
) -> runs.Run:
    """Train an algorithm, as ``python -m baselines.train`` does; see `cfp.fit`.

    Args:
        algo: A name in `ALGORITHMS`.
        task: Task, or ``"MODULE:NAME"`` for a custom one.
        steps: Environment steps, for algorithms with this option; None: those of the preset.
        out: Folder of the run; None: in ``runs/``, named by algorithm, task, preset and seed.
        resume: Continue the run in the folder.
        options: Options of the command line with underscores; ``python -m baselines.train --algo NAME --help`` lists
            them.

    Returns:
        The finished run.

    Raises:
        ConfigError: An option does not exist or is wrong.
        NonFiniteError: Training has diverged.
    """
    if steps is not None:
        options["steps"] = steps
    return Run.fit({"algo": algo, "task": task, **options}, out, resume)
