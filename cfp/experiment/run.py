"""A whole training run of any algorithm: stage after stage, all it leaves in its folder, going on after a stop."""

from __future__ import annotations

import json
import math
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import RunConfig, to_json
from cfp.envs.make import choose_device, make_env
from cfp.errors import CFPError, CheckpointError, ConfigError
from cfp.evaluation.page import write_page
from cfp.evaluation.plots import plot_curve
from cfp.evaluation.rollout import Policy, Result, compare, evaluate, format_table, to_rows
from cfp.evaluation.video import VideoUnavailable, film, film_episode, write_video
from cfp.experiment.books import Books
from cfp.experiment.estimate import Cost
from cfp.experiment.loggers import ProgressTable, Tracker, check_trackers
from cfp.experiment.process import Plateau, StopSignals
from cfp.experiment.state_file import Position, StateFile, check_same
from cfp.files import copy_atomically, read_json, write_json
from cfp.tables import Table, read_table
from cfp.weights import is_of_another_task, read_policy

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
"""Columns of ``evaluations.csv``."""

MARKS = ("config.json", "checkpoint", "progress.csv", "evaluations.csv", "policy.safetensors")
"""Any of these in a folder means that it holds a run."""


def holds_run(folder: Path) -> bool:
    """Whether a folder holds a run, whole or begun."""
    return any((folder / name).exists() for name in MARKS)


def read_config(folder: Path, configure: Callable[[dict[str, Any]], RunConfig]) -> RunConfig:
    """Options of the run in a folder.

    Args:
        folder: Of the run.
        configure: From JSON values to options.

    Raises:
        CheckpointError: There is no run, or its ``config.json`` cannot be read.
    """
    path = folder / "config.json"
    try:
        config = configure(read_json(path))
        config.check()
        return config
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder}: there is no run (no config.json)") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error


def stage_files(folder: Path, stages: int) -> dict[str, Path]:
    """Policies of a run so far by name: finished stages, then the one in training or trained last."""
    done = {f"stage {stage}": folder / f"stage{stage}.safetensors" for stage in range(1, stages)}
    files = {name: path for name, path in done.items() if path.exists()}
    newest = folder / "policy.safetensors"
    if newest.exists():
        files[f"stage {read_policy(newest)[1]['stage']}"] = newest
    return files


class Run(ABC):
    """Trains all stages of a run in its folder.

    ``policy.safetensors`` is the policy with the best evaluation of its stage so far (without evaluations: the newest);
    it is what the next stage starts from and what the final table judges, on layouts of its own.

    What is called a model here has stable-baselines3's ``predict`` and counts the steps of its stage in
    ``num_timesteps``.

    Args:
        config: The run's options.
        folder: Its folder.
        resume: Go on from the folder's checkpoint; without one, start from the beginning.
        signals: Whether the user wants to stop.

    Attributes:
        step: Environment steps of the run so far.
        judging: Seconds that this session has spent on evaluations.
        teaching: Environment steps, and seconds without evaluations, that it has spent on the training of a teacher.

    Raises:
        ConfigError: The folder already holds a run and ``resume`` is not set (nothing in it is touched), or the options
            do not fit its checkpoint.
        CheckpointError: The checkpoint is damaged.
    """

    checkpoint_type: type[StateFile] = StateFile

    def __init__(self, config: RunConfig, folder: Path, resume: bool, signals: StopSignals) -> None:
        config.check()
        choose_device(config.device)
        check_trackers(config)
        for level in range(len(config.ends())):
            make_env(config, config.action_size(level), 1)  # refuses bad options before anything is written
        self.config, self.folder, self.signals = config, folder, signals
        if holds_run(folder) and not resume:
            raise ConfigError(f"out: {folder} already holds a run, allowed with --resume; or name another folder")
        self.checkpoint = self.checkpoint_type(folder / "checkpoint")
        self.state: dict[str, Any] | None = None
        self.position = Position()
        if resume and self.checkpoint.exists():
            self.state = self.checkpoint.load()
            check_same(json.loads(self.state["config"]), config)
            self.position = Position(self.state["level"], self.state["offset"])
            if self.position.level >= len(config.ends()):
                raise self.checkpoint.misfit(ValueError(f"it is of stage {self.position.level + 1}"))
            step = self.position.offset + self.state["model"]["num_timesteps"]
            print(f"resuming {folder} at step {step} of {config.ends()[-1]} (stage {self.position.level + 1})")
            newest = folder / "policy.safetensors"
            if newest.exists() and is_of_another_task(read_policy(newest)[1], config.task):
                print(f"the file of task {config.task!r} has changed: evaluations from before it are of another task")
        elif resume:
            print(f"{folder} holds no checkpoint: starting from the beginning")
        if self.state is None:
            self.position = self.begin()
            step = self.position.offset
        self.step, self.judging, self.teaching = step, 0.0, (0, 0.0)
        write_json(folder / "config.json", to_json(config))
        self.evaluations = Table(folder / "evaluations.csv", step, ("step", "stage", "mean"))
        progress = ProgressTable(Table(folder / "progress.csv", step))
        self.tracker = Tracker(config, folder, step)
        self.logger = Logger(str(folder), [progress, *self.tracker.writers])

    def begin(self) -> Position:
        """Where a run begins that has no checkpoint; puts what the first stage needs into the folder."""
        return Position()

    def inherit(self, model: Any, previous: Any) -> None:  # noqa: B027  (most algorithms hand over a policy only)
        """Give a model that has just been made what it shall have of the stage before, besides its policy."""

    def pictures(self, model: Any) -> dict[str, np.ndarray]:
        """What to show of a model at an evaluation, uint8 (H, W, 3) by name."""
        return {}

    def begins_trained(self, level: int) -> bool:
        """Whether a stage begins with a policy that has been trained: then it is evaluated before the first step."""
        return level > 0

    @abstractmethod
    def make_model(self, level: int) -> Any:
        """The model of a stage as it begins; the policy of the one before is in the folder."""

    @abstractmethod
    def restore(self, model: Any, state: dict[str, Any]) -> None:
        """Put the state of a checkpoint into a model that has just been made."""

    @abstractmethod
    def save(self, model: Any) -> None:
        """Write a checkpoint of the model at `position`."""

    @abstractmethod
    def keep(self, model: Any, level: int, step: int) -> None:
        """Write the model's policy of a step of the run as ``policy.safetensors``."""

    @abstractmethod
    def learn(self, model: Any, steps: int, books: Books) -> None:
        """Train the model for some more steps and keep the books."""

    @abstractmethod
    def load(self, path: Path) -> Policy:
        """Load a policy that `keep` wrote."""

    @abstractmethod
    def measure(self, model: Any) -> Cost:
        """Time a few steps and updates of a model that has just been made; what it has learned is spoiled."""

    def unmeasured(self) -> list[str]:
        """Work that `measure_all` leaves out, a line for each."""
        return []

    def measure_all(self) -> list[Cost]:
        """`measure` every stage that is to be trained, each over the untrained policy of the one before."""
        costs = []
        for level in range(self.position.level, len(self.config.ends())):
            model = self.make_model(level)
            self.keep(model, level, 0)
            copy_policy(self.folder / "policy.safetensors", self.folder / f"stage{level + 1}.safetensors")
            costs.append(self.measure(model))
        self.logger.close()
        return costs

    def remarks(self) -> list[str]:
        """What the user may not expect of the stages that are left, a line each."""
        return []

    def train(self) -> None:
        """Train the stages that are left."""
        for line in self.remarks():
            print(line)
        try:
            self._train()
        finally:
            self.logger.close()

    def _train(self) -> None:
        ends, previous = self.config.ends(), None
        for level in range(self.position.level, len(ends)):
            model = self._first_model(level) if previous is None else self.make_model(level)
            if previous is not None:
                self.inherit(model, previous)
            if self.state is not None:
                self.restore(model, self.state)
                self.state = None
            left = ends[level] - self.position.offset - model.num_timesteps
            step, books, early = self.position.offset + model.num_timesteps, self._books(level, model), False
            # A process that is killed between the last step and the last evaluation leaves nothing but the latter.
            if not self._plateau(level) if left > 0 else books.lacks_evaluation(step):
                (self.folder / "results.json").unlink(missing_ok=True)  # of an earlier end, which is none any more
                try:
                    if left > 0:
                        self.learn(model, left, books)
                    else:
                        books.open(step)
                        books.close(step, dict)
                except Plateau:
                    early = True
                finally:
                    self.step = self.position.offset + model.num_timesteps
                    books.leave()
                if early:
                    print(f"stage {level + 1} ends early: {self.config.report.patience} evaluations without a new best")
            previous = model
            if level + 1 < len(ends):
                newest = self.folder / "policy.safetensors"
                if read_policy(newest)[1]["stage"] == level + 1:  # else it was done before a crash in the next stage
                    copy_policy(newest, self.folder / f"stage{level + 1}.safetensors")
                self.position = Position(level + 1, self.position.offset + model.num_timesteps)

    def _first_model(self, level: int) -> Any:
        """The model that this session begins with; options that it refuses leave no run behind."""
        try:
            return self.make_model(level)
        except CFPError:
            if self.state is None:
                (self.folder / "config.json").unlink()
            raise

    def _plateau(self, level: int) -> bool:
        """Whether the best evaluation of a stage is as many evaluations ago as the run is patient."""
        means = [float(row["mean"]) for row in self.evaluations.rows if int(row["stage"]) == level + 1]
        patience = self.config.report.patience
        return bool(patience and means) and len(means) - 1 - means.index(max(means)) >= patience

    def _books(self, level: int, model: PolicyPredictor) -> Books:
        config = self.config
        seed, episodes = config.evaluation(level)
        rows = read_table(self.folder / "evaluations.csv", ("step", "stage", "mean"))
        rows = [row for row in rows if int(row["stage"]) == level + 1]
        best = max((float(row["mean"]) for row in rows), default=-math.inf)

        def measure(step: int) -> Result:
            nonlocal best
            begun = time.perf_counter()
            deterministic = config.report.eval_deterministic
            env = make_env(config, config.action_size(level), episodes)
            result = evaluate("", model, env, episodes, deterministic=deterministic, seed=seed)
            row: dict[str, Any] = {"step": step, "stage": level + 1, "episodes": episodes}
            row |= {"mean": result.mean, "std": result.std}
            row |= {"lowest": min(result.returns), "highest": max(result.returns), "success": result.success}
            if result.mean > best:  # before the row: a crash between the two repeats the evaluation
                best = result.mean
                self.keep(model, level, step)
            self.evaluations.add(row)
            self.judging += time.perf_counter() - begun
            shown = {"eval/return": result.mean, "eval/std": result.std, "eval/success": result.success}
            self.tracker.show(step, {**shown, **self.pictures(model)})
            return result

        def record(step: int) -> None:
            path = self.folder / "videos" / f"step{step:09d}.mp4"
            size = config.action_size(level)
            write_video(path, film_episode(config, model, size, config.report.eval_deterministic, seed))
            self.tracker.film(step, path)

        def save(step: int) -> None:
            if best == -math.inf:  # not evaluated yet, or never
                self.keep(model, level, step)
            self.save(model)

        # Such a stage must do better than what it begins with.
        first = self.begins_trained(level) and config.report.eval_every > 0 and best == -math.inf
        evaluated = int(rows[-1]["step"]) if rows else 0
        ends, over = config.ends(), partial(self._plateau, level)
        return Books(
            level=level,
            end=ends[level],
            total=ends[-1],
            report=config.report,
            signals=self.signals,
            logger=self.logger,
            evaluate=measure,
            save=save,
            evaluate_first=first,
            evaluated=evaluated,
            over=over,
            film=record,
        )

    def policies(self) -> dict[str, Policy]:
        """Policies of the run so far by name, see `stage_files`."""
        return {name: self.load(path) for name, path in stage_files(self.folder, len(self.config.ends())).items()}

    def finish(self) -> list[Result]:
        """After training: the final table, ``results.json``, curve, video and page. Returns the table's rows."""
        policies = self.policies()
        results = compare(self.config, policies, self.config.report.eval_episodes)
        write_json(self.folder / "results.json", to_rows(results))
        untrained = {result.name: result.mean for result in results[:2]}
        print(f"learning curve: {plot_curve(self.folder, self.config, untrained)}")
        if self.config.report.video:
            make_video(self.config, list(policies.values())[-1], self.folder / "video.mp4")
        print(f"all of it on one page: {write_page(self.folder, self.config, results)}")
        print(format_table(self.config, results))
        return results


def copy_policy(source: Path, target: Path) -> None:
    """Copy a ``.safetensors`` file and the ``.json`` beside it."""
    for suffix in (".safetensors", ".json"):
        copy_atomically(source.with_suffix(suffix), target.with_suffix(suffix))


def make_video(config: RunConfig, policy: Policy, path: Path, aside: bool = False) -> None:
    """Film one episode of a policy; without the optional packages, say how to get them and go on.

    Args:
        config: The run's options.
        policy: Acts.
        path: Of the MP4 file.
        aside: Say it on the standard error, where the standard output is for a program to read.
    """
    told = sys.stderr if aside else sys.stdout
    try:
        write_video(path, film(config, policy))
    except VideoUnavailable as error:
        print(error, file=told)
    else:
        print(f"video: {path}", file=told)
