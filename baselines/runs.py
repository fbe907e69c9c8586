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
    """Train any algorithm in a run folder, as ``torchmpm train --algo`` does, see `cfp.fit`.

    Args:
        algo: A name from `baselines.ALGORITHMS`, or ``"MODULE:CLASS"``.
        task: A task name, or ``"MODULE:NAME"`` for a custom task.
        steps: Environment steps of all robots in all stages together, for algorithms with this option; None for those
            of the preset.
        out: Folder of the run; None for a folder in ``runs/`` that is named by algorithm, task, preset and seed.
        resume: Continue the run in the folder, or start one if there is none.
        options: ``quiet`` and ``on_evaluation`` of `cfp.fit`, and all other options of the algorithm, the fields of its
            dataclass of options, such as `baselines.GradientConfig`; ``torchmpm train --algo NAME --help`` lists them.

    Returns:
        The finished run.

    Raises:
        cfp.ConfigError: There is no such algorithm or option, or a value is wrong.
        cfp.CheckpointError: A policy or the checkpoint is missing, damaged, or of other options.
        cfp.CFPError: Another process trains in the folder.
        cfp.NonFiniteError: The training has diverged.

    Examples:
        >>> import baselines
        >>> run = baselines.fit("gradient", "shapematch", video=False, out="runs/plan")  # doctest: +SKIP
        >>> returns = [row["mean"] for row in run.evaluations]  # doctest: +SKIP
    """
    return runs.fit(task, steps=steps, out=out, resume=resume, algo=algo, **options)
