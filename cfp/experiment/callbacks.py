"""Callbacks between two updates of a stage: logs, evaluations, checkpoints, stopping."""

from __future__ import annotations

import importlib
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import (
    HParam,
    Image,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
    filter_excluded_keys,
)
from torch.utils.tensorboard import SummaryWriter

from cfp.config import RunConfig, to_json
from cfp.errors import ConfigError
from cfp.evaluation.returns import EpisodesStopped, evaluate, make_trial
from cfp.experiment.checkpoint import Checkpoint
from cfp.experiment.cli import Stopped, StopSignals
from cfp.experiment.folder import policy_path
from cfp.files import write_text
from cfp.learner import Learner
from cfp.messages import progress_bar
from cfp.policy import describe_run
from cfp.tables import CSVTable

#: Called with each new row of ``evaluations.csv``; may raise an exception to end the training.
OnEvaluation: TypeAlias = Callable[[dict[str, Any]], object]
#: Scalars that every algorithm logs beside its own.
LOG_METRICS: dict[str, str] = {
    "stage": "stage in training, 1 is the first",
    "time/steps_per_second": "environment steps per second of wall time since the last point (TensorBoard only)",
}
#: Columns of ``evaluations.csv``.
EVALUATION_COLUMNS: dict[str, str] = {
    "step": "environment steps of the run so far",
    "stage": "stage in training, 1 is the first",
    "episodes": "episodes of the evaluation, each on a layout of its own that is not trained on",
    "mean": "mean of their undiscounted returns; a stage keeps the policy with the highest",
    "std": "standard deviation of the returns",
    "lowest": "lowest return",
    "highest": "highest return",
    "success": "share of successes, where the task defines success",
}
#: Scalars of an evaluation in TensorBoard.
EVALUATION_METRICS: dict[str, str] = {
    "eval/return": "mean undiscounted return of an evaluation's episodes (the column mean of evaluations.csv)",
    "eval/std": "standard deviation of these returns",
    "eval/success": "share of successes among them, where the task defines success",
    "reward/TERM": "what each term of the task's reward, with its weight, contributes to eval/return",
}


class ProgressTable(KVWriter):
    """A logger output that appends to ``progress.csv``; stable-baselines3's own starts the file anew."""

    def __init__(self, table: CSVTable) -> None:
        self.table = table

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Append one row."""
        values = filter_excluded_keys(key_values, key_excluded, "csv")
        self.table.add({"step": step, **{key: values[key] for key in sorted(values)}})

    def close(self) -> None:
        """Nothing is held open."""


class EventFile(TensorBoardOutputFormat):
    """TensorBoard events that, on a resumed run, replace what was logged past the checkpoint."""

    def __init__(self, folder: Path, step: int) -> None:
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=step + 1 if step else None)
        self._is_closed = False

    def write_options(self, config: RunConfig) -> None:
        """Show the options of the run under HParams, beside its evaluations."""
        plain = {name: v if isinstance(v, bool | int | float) else str(v) for name, v in to_json(config).items()}
        shown = HParam(plain, dict.fromkeys(("eval/return", "eval/success"), 0.0))  # the last values count, not these
        self.write({"options": shown}, {"options": ()})


def check_wandb(config: RunConfig) -> None:
    """Refuse Weights & Biases where it is not installed, before anything is written."""
    if config.wandb != "off":
        try:
            importlib.import_module("wandb")
        except ImportError as error:
            install = "install it with: pip install 'torchmpm[wandb]'"
            message = f"wandb must be 'off' without the package wandb, got {config.wandb!r}; {install}"
            raise ConfigError(message) from error


class WandbWriter(KVWriter):
    """A logger output to Weights & Biases; a resumed run continues the same curve."""

    def __init__(self, config: RunConfig, folder: Path) -> None:
        self.wandb = importlib.import_module("wandb")
        identity = folder / "wandb-id.txt"
        if not identity.exists():
            write_text(identity, uuid.uuid4().hex[:8])
        self.run = self.wandb.init(
            project=config.wandb_project,
            name=config.name,
            id=identity.read_text().strip(),
            resume="allow",
            mode=config.wandb,
            dir=str(folder),
            config=to_json(config),
        )
        # The steps of a resumed run may begin before the last one that was sent, which its own counter refuses.
        self.run.define_metric("step")
        self.run.define_metric("*", step_metric="step")

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Send one point; what does not exist yet (None) is left out."""
        given = {name: value for name, value in key_values.items() if value is not None}
        images = {name: self.wandb.Image(value.image) for name, value in given.items() if isinstance(value, Image)}
        self.run.log({**given, **images, "step": step})

    def close(self) -> None:
        """End the session."""
        self.run.finish()


def make_trackers(config: RunConfig, folder: Path, step: int) -> list[KVWriter]:
    """The places to which a run's rows go besides its tables."""
    events = EventFile(folder / "tensorboard", step)
    events.write_options(config)
    return [events, WandbWriter(config, folder)] if config.wandb != "off" else [events]


@dataclass
class Stage:
    """A stage in training."""

    config: RunConfig
    folder: Path
    learner: Learner
    offset: int  # environment steps of the stages before
    evaluation_due: bool = False  # the signal that stopped the last session came during an evaluation

    @property
    def number(self) -> int:
        """1 is the first."""
        return self.learner.stage

    @property
    def step(self) -> int:
        """Environment steps since the beginning of the run."""
        return self.offset + self.learner.num_timesteps

    @property
    def steps_left(self) -> int:
        """Environment steps until the end of the stage."""
        return max(0, self.config.ends()[self.number - 1] - self.step)

    def save_policy(self) -> None:
        """Write the present policy as ``policy.safetensors``."""
        description = describe_run(self.config, self.config.algo, self.number, self.step)
        self.learner.save_policy(policy_path(self.folder), description)


class RunCallback(BaseCallback):
    """What happens between two updates of a stage: a row of the log, an evaluation, a checkpoint, the end of the run.

    Each is due where the steps have passed a multiple of an option, and at the end of the stage; all earlier steps have
    been learned from then. An evaluation keeps the best policy of the stage, if the algorithm does not keep the newest.
    A trained policy is evaluated before its first step, and then not again until it learns. A checkpoint follows each
    evaluation, and comes before a stop.

    Args:
        stage: The stage in training.
        table: Of the evaluations of the run.
        trackers: Where the scalars of evaluations go.
        checkpoint: Of the run.
        signals: Of the user who wants to stop the run.
        on_evaluation: See `OnEvaluation`.
    """

    def __init__(
        self,
        stage: Stage,
        table: CSVTable,
        trackers: Logger,
        checkpoint: Checkpoint,
        signals: StopSignals,
        on_evaluation: OnEvaluation | None,
    ) -> None:
        super().__init__()
        self.stage, self.table, self.trackers = stage, table, trackers
        self.checkpoint, self.signals, self.on_evaluation = checkpoint, signals, on_evaluation
        self.bar, self._shown = progress_bar(disable=True), dict[str, str]()
        self._last = self._logged = self._saved = stage.step
        rows = [row for row in table.rows if int(row["stage"]) == stage.number]
        self.means = [float(row["mean"]) for row in rows]  # earlier sessions included
        self.evaluated = int(rows[-1]["step"]) if rows else 0  # step of the last evaluation
        self._row = dict[str, Any]()  # of an evaluation that was not reported yet

    @property
    def is_missing(self) -> bool:
        """Whether the policy of the present step has not been evaluated."""
        return self.stage.config.eval_every > 0 and self.evaluated < self.stage.step

    def _on_training_start(self) -> None:
        stage, self._clock = self.stage, time.perf_counter()
        self.bar = progress_bar(total=stage.config.ends()[-1], initial=stage.step, desc=f"stage {stage.number}")
        starts_trained = stage.learner.starts_trained and stage.config.eval_every and not self.means
        if starts_trained or (stage.evaluation_due and self.is_missing):  # a crash may have come after its row
            self._evaluate()

    def _on_step(self) -> bool:
        self.bar.update(self.stage.step - self.bar.n)
        return True

    def _on_rollout_start(self) -> None:
        config, learner = self.stage.config, self.stage.learner
        if self._has_passed(config.log_every):
            self._log()
        initial = learner.starts_trained and learner.num_timesteps <= learner.steps_without_change
        if self._has_passed(config.eval_every) and not (initial and self.means):
            self._evaluate()
        just_evaluated = self.evaluated == self.stage.step > self._last
        if self._has_passed(config.checkpoint_every) or just_evaluated or self.signals.number:
            self._save()
        self._last = self.stage.step
        self._end()

    def _on_training_end(self) -> None:
        if self._logged < self.stage.step:
            self._log()
        if self.is_missing:
            self._evaluate()
        if self._saved < self.stage.step:
            self._save()
        self._end()

    def _has_passed(self, every: int) -> bool:
        """Whether the steps since the last rollout have passed a multiple of ``every``, 0 for none."""
        return every > 0 and self.stage.step // every > self._last // every

    def _show(self, **values: float) -> None:
        """Show values beside the progress bar."""
        self._shown |= {name: f"{value:.1f}" for name, value in values.items()}
        self.bar.set_postfix(self._shown, refresh=False)  # a bar that has not appeared would end without a new line

    def _log(self) -> None:
        """Write a row to the logger: ``progress.csv``, TensorBoard, Weights & Biases if asked for."""
        now, step, logger = time.perf_counter(), self.stage.step, self.stage.learner.logger
        speed = (step - self._logged) / max(now - self._clock, 1e-9)
        self._logged, self._clock = step, now
        self.stage.learner.log_row()
        logger.record("stage", self.stage.number)
        logger.record("time/steps_per_second", speed, exclude="csv")
        if (value := logger.name_to_value.get("rollout/return")) is not None:
            self._show(**{"return": value})
        logger.dump(step)

    def _evaluate(self) -> None:
        stage, config = self.stage, self.stage.config
        seed, episodes = config.evaluation(stage.number)
        trial = make_trial(
            config,
            "",
            stage.learner.trained_policy,
            episodes,
            deterministic=config.eval_deterministic,
            seed=seed,
            conditions=config.conditions(stage.number),
        )
        try:
            result = evaluate([trial], config.make_spec().horizon, lambda: self.signals.number != 0)[0]
        except EpisodesStopped:
            if not self.signals.number:
                raise
            stage.evaluation_due = True
            return
        stage.evaluation_due = False
        if not stage.learner.keeps_best or result.mean > max(self.means, default=-float("inf")):
            stage.save_policy()  # before the row: a crash between the two repeats the evaluation
        self.means.append(result.mean)
        self.evaluated = stage.step
        lowest, highest = min(result.returns), max(result.returns)
        values = stage.step, stage.number, episodes, result.mean, result.std, lowest, highest, result.success
        self._row = dict(zip(EVALUATION_COLUMNS, values, strict=True))
        self.table.add(self._row)
        scalars = {"eval/return": result.mean, "eval/std": result.std, "eval/success": result.success}
        scalars |= {f"reward/{name}": value for name, value in result.terms.items()}
        for name, value in scalars.items():
            self.trackers.record(name, value)
        for name, picture in stage.learner.images().items():
            self.trackers.record(name, Image(picture, "HWC"))
        self.trackers.dump(stage.step)
        self._show(evaluated=result.mean)

    def _save(self) -> None:
        stage = self.stage
        if not (stage.learner.keeps_best and stage.config.eval_every and self.means):
            stage.save_policy()
        self.checkpoint.save(stage.learner, stage.config, stage.offset, stage.evaluation_due)
        self._saved = stage.step

    def _end(self) -> None:
        """Pass on the row of an evaluation, and stop: after the checkpoint, from which the run then goes on."""
        row, self._row = self._row, {}
        if row and self.on_evaluation is not None:
            self.on_evaluation(row)
        if self.signals.number:
            raise Stopped(self.signals.number)
