"""The books of a stage of training: rows in the logs, evaluations, checkpoints, the progress bar, stopping."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

from stable_baselines3.common.logger import Logger
from tqdm import tqdm

from cfp.evaluation.rollout import Result
from cfp.experiment.process import Plateau, Stopped, StopSignals
from cfp.sections import ReportConfig

BOOK_METRICS: dict[str, str] = {
    "stage": "stage in training, 1 is the first",
    "time/steps_per_second": "environment steps per second of wall time since the last point (TensorBoard only)",
}
"""Scalars that every algorithm logs beside its own."""

Scalars = Callable[[], Mapping[str, float | None]]
"""Called when a row is due; returns an algorithm's own scalars by name, None for those that do not exist yet."""


class Books:
    """Does what is due between two updates.

    Args:
        level: Index of the stage.
        end: Step of the run at which the stage ends.
        total: Environment steps of the whole run, for the progress bar.
        report: How often what happens.
        signals: Whether the user wants to stop.
        logger: Where rows go.
        evaluate: Called with the step; returns the result, which it has written down.
        save: Called with the step; writes policy and checkpoint.
        evaluate_first: Evaluate before the first step.
        evaluated: Step of the stage's last evaluation so far.
        over: Asked after an evaluation: whether the stage should end now.
        film: Called with the step when a film is due.
    """

    def __init__(
        self,
        level: int,
        end: int,
        total: int,
        report: ReportConfig,
        signals: StopSignals,
        logger: Logger,
        evaluate: Callable[[int], Result],
        save: Callable[[int], None],
        evaluate_first: bool = False,
        evaluated: int = 0,
        over: Callable[[], bool] = lambda: False,
        film: Callable[[int], None] = lambda step: None,
    ) -> None:
        self.level, self.end, self.total = level, end, total
        self.report, self.signals, self.logger = report, signals, logger
        self.evaluate, self.save, self.evaluate_first = evaluate, save, evaluate_first
        self.over, self.film = over, film
        self.last_result: Result | None = None
        self._return: float | None = None
        self._last = self._logged = self._saved = 0
        self._evaluated = evaluated
        self._clock = time.perf_counter()
        self.bar = tqdm(disable=True)

    def open(self, step: int) -> None:
        """Begin at a step of the run."""
        self._last = self._logged = self._saved = step
        self._clock = time.perf_counter()
        self.bar = tqdm(
            total=self.total,
            initial=step,
            desc=f"stage {self.level + 1}",
            unit="step",
            mininterval=0.1 if sys.stderr.isatty() else 15.0,  # a log file needs fewer lines than a terminal
        )
        if self.evaluate_first:
            self._evaluate(step)

    def advance(self, steps: int) -> None:
        """Move the progress bar."""
        self.bar.update(steps)

    def turn(self, step: int, scalars: Scalars) -> None:
        """Log, evaluate and save if it is time, between two updates.

        Raises:
            Stopped: The user wants to stop before the end of the stage; the checkpoint is written.
            Plateau: The stage is over; the checkpoint is written.
        """
        due, stops = self._due(step), self.signals.number and step < self.end
        self._last = step
        if due["log"]:
            self._log(step, scalars())
        if due["evaluate"]:
            self._evaluate(step)
        if due["film"]:
            self.film(step)
        if due["save"] or due["evaluate"] or stops:
            self._save(step)
        if stops:
            raise Stopped(self.signals.number)
        if due["evaluate"] and self.over():
            raise Plateau

    def _due(self, step: int) -> dict[str, bool]:
        """What has come due since the last turn."""
        periods = {
            "log": self.report.log_every,
            "evaluate": self.report.eval_every,
            "save": self.report.checkpoint_every,
            "film": self.report.video_every,
        }
        return {name: every > 0 and step // every > self._last // every for name, every in periods.items()}

    def close(self, step: int, scalars: Scalars) -> None:
        """End the stage: a last row, evaluation and checkpoint, unless they were just made.

        Raises:
            Stopped: The user wants to stop; the stage is whole.
        """
        if self._logged < step:
            self._log(step, scalars())
        if self.lacks_evaluation(step):
            self._evaluate(step)
        if self._due(step)["film"]:
            self.film(step)
        if self._saved < step:
            self._save(step)
        if self.signals.number:
            raise Stopped(self.signals.number)

    def lacks_evaluation(self, step: int) -> bool:
        """Whether a stage that ends at a step was not evaluated there."""
        return self.report.eval_every > 0 and self._evaluated < step

    def leave(self) -> None:
        """End the line of the progress bar, so that what is said next, an error too, begins one."""
        self.bar.close()

    def _save(self, step: int) -> None:
        self.save(step)
        self._saved = step

    def _evaluate(self, step: int) -> None:
        self.last_result = self.evaluate(step)
        self._evaluated = step
        self._show()

    def _log(self, step: int, scalars: Mapping[str, float | None]) -> None:
        now = time.perf_counter()
        speed = (step - self._logged) / max(now - self._clock, 1e-9)
        self._clock, self._logged = now, step
        self.logger.record("stage", self.level + 1)
        for name, value in scalars.items():
            self.logger.record(name, value)
        self.logger.record("time/steps_per_second", speed, exclude="csv")
        self.logger.dump(step)
        self._return = scalars.get("rollout/return")
        self._show()

    def _show(self) -> None:
        shown: dict[str, Any] = {}
        if self._return is not None:
            shown["return"] = f"{self._return:.1f}"
        if self.last_result is not None:
            shown["evaluated"] = f"{self.last_result.mean:.1f}"
        self.bar.set_postfix(shown)
