"""The teacher of a distillation in the folder of its run: copied there, or trained there first."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from baselines.distillation.config import DistillConfig
from baselines.distillation.teachers import is_record_of_one_start, read_teacher
from baselines.registry import configure, find
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.folder import copy_policy, policy_path
from cfp.experiment.process import StopSignals
from cfp.experiment.run import Run
from cfp.files import read_json, write_json
from cfp.sections import TASK_OPTIONS
from cfp.weights import read_policy, shipped, write_policy

TRAINED = ("shac", "gradient")
"""Teachers that are trained first if only their algorithm is named."""


def teacher_path(folder: Path) -> Path:
    """The copy of the teacher in the folder of a run."""
    return folder / "teacher.safetensors"


def copy_teacher(config: DistillConfig, folder: Path) -> None:
    """Copy the teacher into the folder, if it is a policy."""
    teacher = config.teacher
    if teacher in ("mpc", *TRAINED):
        return
    try:
        read_teacher(teacher, config.task, config.environment)
    except CheckpointError as error:
        if Path(teacher).exists():
            raise
        names = ", ".join(("mpc", *TRAINED, *shipped()))
        raise ConfigError(f"teacher must be {names}, a run folder or a policy.safetensors, got {teacher!r}") from error
    write_policy(teacher_path(folder), *read_policy(teacher))


def warnings(config: DistillConfig, folder: Path) -> list[str]:
    """A warning if the teacher is the record of one episode, in a task whose episodes start differently."""
    if config.teacher in ("mpc", *TRAINED):
        return []
    teacher = read_teacher(teacher_path(folder), config.task, config.environment)
    if not is_record_of_one_start(teacher, config.task, config.environment):
        return []
    return [
        f"teacher: the record of one planned episode, while every episode of {config.task} starts differently; "
        "evaluate it from other starts (python -m baselines.evaluate --policy), or use mpc, which plans anew"
    ]


def train_teacher(config: DistillConfig, folder: Path, signals: StopSignals) -> None:
    """Train the teacher with the defaults of its algorithm, if only that is named and it is not there yet.

    What this took is added up in ``teacher/cost.json``.
    """
    if config.teacher not in TRAINED or teacher_path(folder).exists():
        return
    chosen = configure({"algo": config.teacher, "task": config.task})
    same = {name: getattr(config.environment, name) for name in ("substeps", "dtype", "backend", *TASK_OPTIONS)}
    environment = replace(chosen.environment, **same)
    chosen = replace(chosen, seed=config.seed, device=config.device, environment=environment)
    algorithm, own = find(config.teacher), folder / "teacher"
    run = Run(algorithm, chosen, own, True, signals)
    print(f"training the teacher first: {config.teacher} -> {own}")
    start, begin = run.step, time.perf_counter()
    try:
        run.train()
    finally:
        cost = {"steps": run.step - start, "seconds": time.perf_counter() - begin}
        cost["evaluation_seconds"] = run.evaluation_seconds
        path = own / "cost.json"
        before = read_json(path) if path.exists() else {}
        write_json(path, {name: value + before.get(name, 0) for name, value in cost.items()})
    copy_policy(policy_path(own), teacher_path(folder))
