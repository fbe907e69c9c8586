"""A whole training run of any algorithm: stage after stage, and all that it leaves in its folder."""

from __future__ import annotations

import gc
import json
import shutil
import textwrap
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from stable_baselines3.common.logger import Logger

from cfp.config import RunConfig, to_json
from cfp.envs.make import choose_device, make_env
from cfp.errors import CFPError, CheckpointError, ConfigError, NonFiniteError
from cfp.evaluation.page import draw_curve, write_figure, write_page
from cfp.evaluation.returns import compare, explain, format_table, name_in_table, to_rows
from cfp.evaluation.video import record_policy, save_media
from cfp.experiment.callbacks import OnEvaluation, ProgressTable, RunCallback, Stage, check_wandb, make_trackers
from cfp.experiment.checkpoint import Checkpoint, check_same
from cfp.experiment.cli import StopSignals
from cfp.experiment.folder import holds_progress, holds_run, policy_files, policy_path
from cfp.files import read_json, write_atomically, write_json
from cfp.learner import Learner
from cfp.messages import say
from cfp.policy import copy_policy, read_policy
from cfp.tables import CSVTable
from dittogym.render.frame import png

#: What a finished run says of its policy.
REPORT = ("results.json", "index.html", "curve.png", "video.mp4", "replay.html")


def check_options(config: RunConfig) -> None:
    """Check all that can be checked before anything is written."""
    config.check()
    check_wandb(config)
    for stage in range(1, len(config.ends()) + 1):
        make_env(config, config.action_size(stage), 1, conditions=config.conditions(stage))
    if config.for_training() != config:
        try:
            make_env(config.for_training(), config.action_size(1), 1)
        except ConfigError as error:
            raise ConfigError(f"train_dt or train_particles: {error}") from error


class TrainingRun:
    """Trains all stages of a run in its folder.

    ``policy.safetensors`` is the policy with the best evaluation of its stage so far, from which the next stage starts.
    Without evaluations, or if the algorithm says so, it is the newest.
    """

    def __init__(
        self,
        learner: type[Learner],
        config: RunConfig,
        folder: Path,
        resume: bool,
        signals: StopSignals,
        on_evaluation: OnEvaluation | None = None,
    ) -> None:
        check_options(config)
        self.on_evaluation = on_evaluation
        if holds_progress(folder) and not resume:
            raise ConfigError(
                f"out: {folder} already holds a run; continue it with --resume (resume=True), or name another folder"
            )
        self.learner, self.config, self.folder, self.signals = learner, config, folder, signals
        self.stages = len(config.ends())
        self.checkpoint = Checkpoint(folder / "checkpoint")
        self.state: dict[str, Any] | None = None
        if resume and self.checkpoint.path.exists():
            self._read_checkpoint()
        else:
            if holds_progress(folder):  # the evaluation of the policy it starts from, which precedes any checkpoint
                check_same(self._stored_options(), config)
            if (folder / "results.json").exists():
                raise CheckpointError(f"{folder}: the run is finished, but its checkpoint is missing")
            if holds_run(folder):
                say(f"{folder} holds no checkpoint: starting from the beginning")
            self.stage, self.offset = learner.begin(config, folder)
            self.step = self.offset
        write_json(folder / "config.json", to_json(config))
        self._save_target()
        self.evaluations = CSVTable(folder / "evaluations.csv", self.step, ("step", "stage", "mean"))
        trackers = make_trackers(config, folder, self.step)
        self.trackers = Logger(None, trackers)
        progress = ProgressTable(CSVTable(folder / "progress.csv", self.step))
        self.logger = Logger(str(folder), [progress, *trackers])

    def _save_target(self) -> None:
        """Show the target that the user has chosen as it is used."""
        target, path = self.config.target, self.folder / "target.png"
        used = self.config.make_spec().target
        if target is not None and used is not None:
            pixels = np.where(used, 0, 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)
            picture = png(np.dstack([pixels] * 3))
            write_atomically(path, lambda file: file.write(picture))
            say(f"target: {path}")

    def _stored_options(self) -> dict[str, Any]:
        """The options of the run that the folder holds."""
        path = self.folder / "config.json"
        try:
            return read_json(path)
        except (OSError, ValueError) as error:
            raise CheckpointError(f"{path}: cannot be read ({error})") from error

    def _read_checkpoint(self) -> None:
        """Set state, stage and step from the checkpoint."""
        config, folder, self.state = self.config, self.folder, self.checkpoint.read()
        past, total = json.loads(self.state["config"]), config.ends()[-1]
        check_same(past, config)
        self.stage, self.offset = self.state["stage"], self.state["offset"]
        if self.stage > self.stages:
            raise self.checkpoint.does_not_fit(ValueError(f"it is of stage {self.stage}"))
        self.step = self.offset + self.state["num_timesteps"]
        if total < min(self.step, past.get("steps", 0)):
            raise ConfigError(f"steps must be at least {self.step}, those that the run has taken, got {total}")
        say(f"resuming {folder} at step {self.step} of {total} (stage {self.stage})")

    def train(self) -> None:
        """Train the stages that are left."""
        for line in self.learner.warnings(self.config, self.folder, self.stage):
            say(line)
        try:
            self.learner.prepare(self.config, self.folder, self.signals)
            for number in range(self.stage, self.stages + 1):
                self.stage = number
                due = self.state is not None and self.state.get("evaluation_due", False)
                learner = self._create()
                self._train_stage(Stage(self.config, self.folder, learner, self.offset, due))
                newest = policy_path(self.folder)  # of the next stage already, if this repeats the end after a crash
                if number < self.stages and read_policy(newest)[1]["stage"] == number:
                    copy_policy(newest, policy_path(self.folder, number))
                self.offset += learner.num_timesteps
                del learner
                gc.collect()  # callbacks refer to it; its replay memory would be there beside the next one
        except NonFiniteError as error:
            kept = "the last checkpoint is untouched" if self.checkpoint.path.exists() else "there is no checkpoint yet"
            raise NonFiniteError(f"{error}; {kept}") from error
        finally:
            self.logger.close()

    def _create(self) -> Learner:
        """The learner of the present stage: at its beginning, or as the checkpoint holds it."""
        try:
            learner = self.learner.create(self.config, self.stage, self.folder)
        except CFPError:
            if not self.checkpoint.path.exists():  # options that it refuses leave no run behind
                (self.folder / "config.json").unlink()
                self.logger.close()
                shutil.rmtree(self.folder / "tensorboard")
            raise
        learner.set_logger(self.logger)
        if self.state is not None:
            self.checkpoint.restore(learner, self.state)
            self.state = None
        return learner

    def _train_stage(self, stage: Stage) -> None:
        """Train a stage to its end, unless that was done in an earlier session."""
        callback = RunCallback(
            stage, self.evaluations, self.trackers, self.checkpoint, self.signals, self.on_evaluation
        )
        # A process killed after the last step but before the last evaluation still has to evaluate.
        if not stage.steps_left and not callback.is_missing:
            return
        for name in REPORT:  # of an earlier end of the run
            (self.folder / name).unlink(missing_ok=True)
        try:
            stage.learner.learn(stage.steps_left, callback, None, reset_num_timesteps=False)
        finally:
            callback.bar.close()

    def finish(self) -> None:
        """After training: print the final table, and write ``results.json``, curve, video and page."""
        device, files = choose_device(self.config.device), policy_files(self.folder, self.stages)
        policies = {name: self.learner.load_policy(path, device) for name, path in files.items()}
        results = compare(self.config, policies, self.config.eval_episodes)
        write_json(self.folder / "results.json", to_rows(results))
        say(format_table(self.config, results))
        note = explain(self.config, results, self.learner.keeps_best)
        if note:
            say("\n".join(textwrap.wrap(note, 100)))
        shown = {name_in_table(name, policies[name]): path for name, path in files.items()}
        best = max((result for result in results if result.name in shown), key=lambda result: result.mean).name
        if best != list(shown)[-1]:
            say(f"{best} has the highest mean return; its policy is {shown[best]}")
        untrained = {result.name: result.mean for result in results[:2]}
        with matplotlib.style.context("default"):  # not the user's own, which may need LaTeX
            write_figure(self.folder / "curve.png", draw_curve(self.folder, self.config, untrained))
        say(f"learning curve: {self.folder / 'curve.png'}")
        if self.config.video:
            recording = record_policy(self.config, list(policies.values())[-1])
            save_media(recording, {"video": self.folder / "video.mp4", "replay": self.folder / "replay.html"})
        say(f"all of it on one page: {write_page(self.folder, self.config, results, note)}")
