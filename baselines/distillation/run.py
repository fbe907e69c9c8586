"""The run of a distillation: it keeps its teacher, and trains it if need be."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from baselines.common.algorithm import AlgorithmRun
from baselines.distillation.teachers import is_record_of_another_start, read_teacher
from baselines.distillation.train import Distill, DistillConfig
from cfp.agent.actor_policy import ActorPolicy
from cfp.config import RunConfig
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.estimate import Cost
from cfp.experiment.process import StopSignals
from cfp.experiment.run import Run, copy_policy
from cfp.experiment.state_file import Position
from cfp.sections import TASK_OPTIONS
from cfp.weights import read_policy, shipped, write_policy

TRAINED = ("shac", "gradient")
"""Teachers that are trained first if only their name is given."""


class DistillRun(AlgorithmRun):
    """Distils in its folder, which keeps a copy of the teacher; one that is only named is trained there first.

    Args:
        config: The run's options.
        folder: Its folder.
        resume: Go on from the folder's checkpoint.
        signals: Whether the user wants to stop.
    """

    config: DistillConfig

    def __init__(self, config: RunConfig, folder: Path, resume: bool, signals: StopSignals) -> None:
        super().__init__(Distill, config, folder, resume, signals)

    @property
    def teacher(self) -> Path:
        """The copy of the teacher."""
        return self.folder / "teacher.safetensors"

    def begin(self) -> Position:
        """Take the teacher over, if it is a policy.

        Raises:
            ConfigError: There is no such teacher, or it was trained for something else.
            CheckpointError: The policy is damaged.
        """
        if self.config.teacher not in ("mpc", *TRAINED):
            self._check_teacher()
            write_policy(self.teacher, *read_policy(self.config.teacher))
        return super().begin()

    def remarks(self) -> list[str]:
        """A teacher that may know one start only."""
        lines, (config, path) = super().remarks(), (self.config, self.teacher)
        if config.teacher not in ("mpc", *TRAINED) and is_record_of_another_start(
            read_teacher(path, config.task, config.environment), config.task, config.environment
        ):
            lines.append(
                f"teacher: the record of one planned episode, while every episode of {config.task} starts differently; "
                "see what it gets from other starts (python -m cfp.evaluate --policy), or take mpc, which plans anew"
            )
        return lines

    def _check_teacher(self) -> None:
        teacher = self.config.teacher
        try:
            read_teacher(teacher, self.config.task, self.config.environment)
        except CheckpointError as error:
            if Path(teacher).exists():
                raise
            names = ", ".join(("mpc", *TRAINED, *shipped()))
            raise ConfigError(
                f"teacher: got {teacher!r}, allowed {names}, a run folder or a policy.safetensors"
            ) from error

    def make_model(self, level: int) -> Distill:
        """The student at the beginning of a stage."""
        start = self.load(self.folder / f"stage{level}.safetensors") if level else None
        assert start is None or isinstance(start, ActorPolicy)
        return Distill(self.config, level, start, None if self.config.teacher == "mpc" else self.teacher)

    def train(self) -> None:
        """Train the teacher if need be, then the student."""
        if self.config.teacher in TRAINED and not self.teacher.exists():
            school = self._school()
            print(f"training the teacher first: {self.config.teacher} -> {school.folder}")
            begun, start = school.step, time.perf_counter()
            try:
                school.train()
            finally:
                self.judging += school.judging
                self.teaching = school.step - begun, time.perf_counter() - start - school.judging
            copy_policy(school.folder / "policy.safetensors", self.teacher)
        super().train()

    def measure_all(self) -> list[Cost]:
        """Time the student's stages, with an untrained teacher; its own training is not part of them."""
        if self.config.teacher in TRAINED:
            school = self._school()
            school.keep(school.make_model(0), 0, 0)
            copy_policy(school.folder / "policy.safetensors", self.teacher)
        return super().measure_all()

    def unmeasured(self) -> list[str]:
        """The teacher's own training."""
        if self.config.teacher not in TRAINED:
            return []
        options = f"--algo {self.config.teacher} --task {self.config.task}"
        return [f"the teacher's training, which comes first (python -m baselines.train {options} --dry-run)"]

    def _school(self) -> Run:
        """The run that trains the teacher, with the defaults of its algorithm."""
        from baselines.registry import configure, open_run  # the registry knows this algorithm too

        config = self.config
        chosen = configure({"algo": config.teacher, "task": config.task})
        same = {name: getattr(config.environment, name) for name in ("substeps", "dtype", "backend", *TASK_OPTIONS)}
        environment = replace(chosen.environment, **same)
        chosen = replace(chosen, seed=config.seed, device=config.device, environment=environment)
        return open_run(chosen, self.folder / "teacher", True, self.signals)
