"""Callbacks between two updates of a stage: logs, evaluations, films, checkpoints, stopping."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from cfp.config import RunConfig
from cfp.evaluation.returns import EpisodesStopped, evaluate, make_trial
from cfp.evaluation.video import record_episode
from cfp.experiment.algorithm import Algorithm, Position
from cfp.experiment.checkpoint import Checkpoint
from cfp.experiment.folder import policy_path
from cfp.experiment.loggers import Tracker
from cfp.experiment.process import Stopped, StopSignals
from cfp.policy import describe_run
from cfp.tables import CSVTable
from dittogym.render.recording import record

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


class StageFinished(Exception):
    """A stage ends before its last step because its evaluations no longer improve; its checkpoint is written."""


@dataclass
class Stage:
    """A stage in training."""

    config: RunConfig
    folder: Path
    position: Position
    algorithm: Algorithm
    evaluation_due: bool = False  # the signal that stopped the last session came during an evaluation

    @property
    def number(self) -> int:
        """1 is the first."""
        return self.position.stage

    @property
    def step(self) -> int:
        """Environment steps since the beginning of the run."""
        return self.position.offset + self.algorithm.num_timesteps

    @property
    def steps_left(self) -> int:
        """Environment steps until the end of the stage."""
        return max(0, self.config.ends()[self.number - 1] - self.step)

    def save_policy(self) -> None:
        """Write the present policy as ``policy.safetensors``."""
        description = describe_run(self.config, self.config.algo, self.number, self.step)
        self.algorithm.save_policy(policy_path(self.folder), description)


class StageCallback(BaseCallback):
    """Acts before a rollout, or at the end of a stage, where the steps have passed a multiple of ``every``.

    All earlier steps have been learned from then.
    """

    def __init__(self, stage: Stage, every: int) -> None:
        super().__init__()
        self.stage, self.every = stage, every
        self._last = stage.step

    def _act(self) -> None:
        raise NotImplementedError

    def _is_due(self) -> bool:
        """Whether the steps since the last call have passed a multiple of `every`."""
        last, self._last = self._last, self.stage.step
        return self.every > 0 and self._last // self.every > last // self.every

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self._is_due():
            self._act()

    def _on_training_end(self) -> None:
        self._on_rollout_start()


class ProgressBarCallback(StageCallback):
    """Shows on the standard error how far the run has come."""

    def __init__(self, stage: Stage) -> None:
        super().__init__(stage, 0)
        self.values = dict[str, str]()
        self.bar = tqdm(disable=True)

    def _on_training_start(self) -> None:
        self.bar = tqdm(
            total=self.stage.config.ends()[-1],
            initial=self.stage.step,
            desc=f"stage {self.stage.number}",
            unit="step",
            mininterval=0.1 if sys.stderr.isatty() else 15.0,  # a log file needs fewer lines than a terminal
        )

    def _on_step(self) -> bool:
        self.bar.update(self.stage.step - self.bar.n)
        return True

    def show(self, **values: float) -> None:
        """Show values beside the bar."""
        self.values |= {name: f"{value:.1f}" for name, value in values.items()}
        self.bar.set_postfix(self.values)


class LogCallback(StageCallback):
    """Writes rows to the logger of the algorithm: ``progress.csv``, TensorBoard, Weights & Biases if asked for."""

    def __init__(self, stage: Stage, bar: ProgressBarCallback) -> None:
        super().__init__(stage, stage.config.report.log_every)
        self.bar = bar
        self._logged = stage.step

    def _on_training_start(self) -> None:
        self._clock = time.perf_counter()

    def _act(self) -> None:
        now, step, logger = time.perf_counter(), self.stage.step, self.stage.algorithm.logger
        speed = (step - self._logged) / max(now - self._clock, 1e-9)
        self._logged, self._clock = step, now
        scalars = self.stage.algorithm.row()
        for name, value in {"stage": self.stage.number, **scalars}.items():
            logger.record(name, value)
        logger.record("time/steps_per_second", speed, exclude="csv")
        logger.dump(step)
        if (value := scalars.get("rollout/return")) is not None:
            self.bar.show(**{"return": value})

    def _on_training_end(self) -> None:
        if self._logged < self.stage.step:
            self._act()


class EvaluationCallback(StageCallback):
    """Evaluates the policy and keeps the best of the stage, if the algorithm does not keep the newest.

    A trained one is evaluated before its first step, and then not again until it learns.
    """

    def __init__(
        self, stage: Stage, table: CSVTable, tracker: Tracker, bar: ProgressBarCallback, signals: StopSignals
    ) -> None:
        super().__init__(stage, stage.config.report.eval_every)
        self.table, self.tracker, self.bar, self.signals = table, tracker, bar, signals
        rows = [row for row in table.rows if int(row["stage"]) == stage.number]
        self.means = [float(row["mean"]) for row in rows]  # earlier sessions included
        self.evaluated = int(rows[-1]["step"]) if rows else 0  # step of the last evaluation
        self.seconds = 0.0  # wall time of evaluations in this session

    @property
    def is_missing(self) -> bool:
        """Whether the policy of the present step has not been evaluated."""
        return self.every > 0 and self.evaluated < self.stage.step

    @property
    def has_plateaued(self) -> bool:
        """Whether the best evaluation is as many evaluations ago as the run is patient."""
        patience, means = self.stage.config.report.patience, self.means
        return bool(patience and means) and len(means) - 1 - means.index(max(means)) >= patience

    def _is_due(self) -> bool:
        algorithm = self.stage.algorithm
        initial = algorithm.starts_trained and algorithm.num_timesteps <= algorithm.steps_without_change
        return super()._is_due() and not (initial and self.means)

    def _act(self) -> None:
        start, stage, config = time.perf_counter(), self.stage, self.stage.config
        seed, episodes = config.evaluation(stage.number)
        deterministic = config.report.eval_deterministic
        trial = make_trial(config, "", stage.algorithm.policy, episodes, deterministic=deterministic, seed=seed)
        try:
            result = evaluate([trial], should_stop=lambda: self.signals.number != 0)[0]
        except EpisodesStopped:
            if not self.signals.number:
                raise
            stage.evaluation_due = True
            return
        stage.evaluation_due = False
        if not stage.algorithm.keeps_best or result.mean > max(self.means, default=-float("inf")):
            stage.save_policy()  # before the row: a crash between the two repeats the evaluation
        self.means.append(result.mean)
        self.evaluated = stage.step
        lowest, highest = min(result.returns), max(result.returns)
        values = stage.step, stage.number, episodes, result.mean, result.std, lowest, highest, result.success
        self.table.add(dict(zip(EVALUATION_COLUMNS, values, strict=True)))
        self.seconds += time.perf_counter() - start
        scalars = {"eval/return": result.mean, "eval/std": result.std, "eval/success": result.success}
        self.tracker.show(stage.step, {**scalars, **stage.algorithm.images()})
        self.bar.show(evaluated=result.mean)

    def _on_training_start(self) -> None:
        starts_trained = self.stage.algorithm.starts_trained and self.every and not self.means
        if starts_trained or (self.stage.evaluation_due and self.is_missing):  # a crash may have come after its row
            self._act()

    def _on_training_end(self) -> None:
        if self.is_missing:
            self._act()


class FilmCallback(StageCallback):
    """Films one episode on the first layout of the evaluations, into ``videos/``."""

    def __init__(self, stage: Stage, tracker: Tracker) -> None:
        super().__init__(stage, stage.config.report.video_every)
        self.tracker = tracker

    def _act(self) -> None:
        stage, config = self.stage, self.stage.config
        path = stage.folder / "videos" / f"step{stage.step:09d}.mp4"
        (seed, _), deterministic = config.evaluation(stage.number), config.report.eval_deterministic
        record_episode(config, stage.algorithm.policy, deterministic, seed, record).save(path)
        self.tracker.film(stage.step, path)


class CheckpointCallback(StageCallback):
    """Writes a checkpoint: at intervals, after each evaluation, before the run is stopped, and at the end."""

    def __init__(self, stage: Stage, checkpoint: Checkpoint, evaluation: EvaluationCallback, signals: StopSignals):
        super().__init__(stage, stage.config.report.checkpoint_every)
        self.checkpoint, self.evaluation, self.signals = checkpoint, evaluation, signals
        self._saved = stage.step

    def _act(self) -> None:
        stage = self.stage
        if not (stage.algorithm.keeps_best and self.evaluation.every and self.evaluation.means):
            stage.save_policy()
        self.checkpoint.save(stage.algorithm, stage.config, stage.position, stage.evaluation_due)
        self._saved = self.stage.step

    def _on_rollout_start(self) -> None:
        just_evaluated = self.evaluation.evaluated == self.stage.step > self._last
        if self._is_due() or just_evaluated or self.signals.number:
            self._act()

    def _on_training_end(self) -> None:
        if self._saved < self.stage.step:
            self._act()


class StopCallback(StageCallback):
    """Stops the run when the user wants to, and the stage when its evaluations no longer improve."""

    def __init__(self, stage: Stage, evaluation: EvaluationCallback, signals: StopSignals) -> None:
        super().__init__(stage, 0)
        self.evaluation, self.signals = evaluation, signals

    def _on_rollout_start(self) -> None:
        self._on_training_end()
        if self.evaluation.has_plateaued:
            raise StageFinished

    def _on_training_end(self) -> None:
        if self.signals.number:
            raise Stopped(self.signals.number)
