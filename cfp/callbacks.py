"""What happens between two rollouts: rows in the logs, evaluations, checkpoints, stopping."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from tqdm import tqdm

from cfp.algorithm import CFP
from cfp.config import ReportConfig
from cfp.evaluation import Result
from cfp.process import Stopped, StopSignals

ROLLOUT_METRICS: dict[str, str] = {
    "stage": "level of the ladder in training, 1 is the coarsest",
    "rollout/return": "mean undiscounted return of the last training episodes (with action noise)",
    "rollout/length": "their mean length in environment steps",
    "rollout/success": "share of successes among them, where the task defines success",
    "rollout/episodes": "episodes finished in this stage",
    "time/steps_per_second": "environment steps per second of wall time since the last point (TensorBoard only)",
}
"""Scalars logged beside `cfp.algorithm.METRICS`."""


class StageCallback(BaseCallback):
    """Keeps the books of one level.

    Everything happens at the start of a rollout, when each step taken has been stored and learned from.

    Args:
        level: Index of the level.
        offset: Environment steps of the levels before it.
        total: Environment steps of the whole run, for the progress bar.
        report: How often what happens.
        signals: Whether the user wants to stop.
        evaluate: Called with the step; returns the result, which it has written down.
        save: Writes policy and checkpoint.
        evaluate_first: Evaluate before the first step.
    """

    def __init__(
        self,
        level: int,
        offset: int,
        total: int,
        report: ReportConfig,
        signals: StopSignals,
        evaluate: Callable[[int], Result],
        save: Callable[[int], None],
        evaluate_first: bool = False,
    ) -> None:
        super().__init__()
        self.level, self.offset, self.total = level, offset, total
        self.report, self.signals = report, signals
        self.evaluate, self.save, self.evaluate_first = evaluate, save, evaluate_first
        self.last_result: Result | None = None
        self._last = self._logged = self._saved = self._evaluated = 0
        self._clock = time.perf_counter()

    @property
    def step(self) -> int:
        """Environment steps since the beginning of the run."""
        return self.offset + self.model.num_timesteps

    def _on_training_start(self) -> None:
        self._last = self._logged = self._saved = self._evaluated = self.step
        self._clock = time.perf_counter()
        self.bar = tqdm(
            total=self.total,
            initial=self.step,
            desc=f"stage {self.level + 1}",
            unit="step",
            mininterval=0.1 if sys.stderr.isatty() else 15.0,  # a log file needs fewer lines than a terminal
        )
        if self.evaluate_first:
            self._evaluate()

    def _on_step(self) -> bool:
        self.bar.update(self.training_env.num_envs)
        return True

    def _on_rollout_start(self) -> None:
        due = {
            name: every > 0 and self.step // every > self._last // every
            for name, every in (
                ("log", self.report.log_every),
                ("evaluate", self.report.eval_every),
                ("save", self.report.checkpoint_every),
            )
        }
        self._last = self.step
        if due["log"]:
            self._log()
        if due["evaluate"]:
            self._evaluate()
        if due["save"] or due["evaluate"] or self.signals.number:
            self._save()
        if self.signals.number:
            self.bar.close()
            raise Stopped(self.signals.number)

    def _on_training_end(self) -> None:
        """Close the level: a last row, evaluation and checkpoint, unless they were just made."""
        if self._logged < self.step:
            self._log()
        if self.report.eval_every and self._evaluated < self.step:
            self._evaluate()
        if self._saved < self.step:
            self._save()
        self.bar.close()

    def _save(self) -> None:
        self.save(self.step)
        self._saved = self.step

    def _evaluate(self) -> None:
        self.last_result = self.evaluate(self.step)
        self._evaluated = self.step
        self._show()

    def _log(self) -> None:
        assert isinstance(self.model, CFP)
        now = time.perf_counter()
        speed = (self.step - self._logged) / max(now - self._clock, 1e-9)
        self._clock, self._logged = now, self.step
        record = self.logger.record
        record("stage", self.level + 1)
        record("rollout/return", self._recent("r"))
        record("rollout/length", self._recent("l"))
        record("rollout/episodes", self.model._episode_num)
        if self.model.ep_success_buffer:
            record("rollout/success", float(np.mean(self.model.ep_success_buffer)))
        record("time/steps_per_second", speed, exclude="csv")
        self.logger.dump(self.step)
        self._show()

    def _recent(self, key: str) -> float | None:
        episodes = self.model.ep_info_buffer
        return float(np.mean([float(episode[key]) for episode in episodes])) if episodes else None

    def _show(self) -> None:
        shown: dict[str, Any] = {}
        recent = self._recent("r")
        if recent is not None:
            shown["return"] = f"{recent:.1f}"
        if self.last_result is not None:
            shown["evaluated"] = f"{self.last_result.mean:.1f}"
        self.bar.set_postfix(shown)
