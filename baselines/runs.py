"""Training from Python, whatever the algorithm: the same runs as those of the command line."""

from __future__ import annotations

import os
from typing import Any

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp import runs
from cfp.runs import Run

__all__ = ["Run", "fit"]


def fit(
    algo: str,
    task: str,
    *,
    steps: int | None = None,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    **options: Any,
) -> Run:
    """Train an algorithm, as ``torchmpm train`` does; see `cfp.fit`.

    Args:
        algo: A name in `ALGORITHMS`.
        task: Task, or ``"MODULE:NAME"`` for a custom one.
        steps: Environment steps, for algorithms with this option; None: those of the preset.
        out: Folder of the run; None: in ``runs/``, named by algorithm, task, preset and seed.
        resume: Continue the run in the folder.
        options: ``quiet``, ``on_evaluation``, and options of the command line with underscores, which ``torchmpm train
            --algo NAME --help`` lists.

    Returns:
        The finished run.

    Raises:
        ConfigError: An option does not exist or is wrong.
        NonFiniteError: Training has diverged.
    """
    return runs.fit(task, steps=steps, out=out, resume=resume, algo=algo, **options)
