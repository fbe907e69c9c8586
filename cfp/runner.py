"""A whole training run: one level after another, everything it leaves in its folder, and going on after a stop."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecMonitor

from cfp.algorithm import CFP
from cfp.callbacks import StageCallback
from cfp.checkpoint import Checkpoint, Position, check_same
from cfp.config import Config, to_json
from cfp.environments import choose_device, make_env
from cfp.errors import CheckpointError, ConfigError
from cfp.evaluation import Result, compare, evaluate, format_table, to_rows
from cfp.files import EventFile, ProgressTable, Table, read_table, write_json
from cfp.plot import plot_curve
from cfp.policy import ActorPolicy, CFPPolicy
from cfp.presets import from_json
from cfp.process import StopSignals
from cfp.video import VideoUnavailable, film, write_video
from cfp.weights import describe, load, save_policy

MARKS = ("config.json", "checkpoint", "progress.csv", "evaluations.csv", "policy.safetensors")
"""Any of these in a folder means that it holds a run."""


def holds_run(folder: Path) -> bool:
    """Whether a folder holds a run, whole or begun."""
    return any((folder / name).exists() for name in MARKS)


def read_config(folder: Path) -> Config:
    """Options of the run in a folder.

    Raises:
        CheckpointError: There is no run, or its ``config.json`` cannot be read.
    """
    path = folder / "config.json"
    try:
        return from_json(json.loads(path.read_text()))
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder}: there is no run (no config.json)") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error


def stage_files(folder: Path, levels: int) -> dict[str, Path]:
    """Policies of a run so far by name: finished levels, then the one in training or trained last."""
    done = {f"stage {level + 1}": folder / f"stage{level + 1}.safetensors" for level in range(levels - 1)}
    files = {name: path for name, path in done.items() if path.exists()}
    newest = folder / "policy.safetensors"
    if newest.exists():
        files[f"stage {load(newest).description['stage']}"] = newest
    return files


class Runner:
    """Trains all levels of a run in its folder.

    ``policy.safetensors`` is the policy with the best evaluation of its level so far (without evaluations: the newest);
    it is what the next level freezes and what the final table judges, on layouts of its own.

    Args:
        config: The run's options.
        folder: Its folder.
        resume: Go on from the folder's checkpoint; without one, start from the beginning.
        signals: Whether the user wants to stop.

    Raises:
        ConfigError: The folder already holds a run and ``resume`` is not set (nothing in it is touched), or the options
            do not fit its checkpoint.
        CheckpointError: The checkpoint is damaged.
    """

    def __init__(self, config: Config, folder: Path, resume: bool, signals: StopSignals) -> None:
        config.check()
        choose_device(config.device)
        make_env(config, config.resolutions[0], 1)  # refuses bad options before anything is written
        self.config, self.folder, self.signals = config, folder, signals
        if holds_run(folder) and not resume:
            raise ConfigError(f"out: {folder} already holds a run, allowed with --resume; or name another folder")
        self.checkpoint = Checkpoint(folder / "checkpoint")
        self.state: dict[str, Any] | None = None
        self.position = Position()
        step = 0
        if resume and self.checkpoint.exists():
            self.state = self.checkpoint.load()
            check_same(json.loads(self.state["config"]), config)
            self.position = Position(self.state["level"], self.state["offset"])
            step = self.position.offset + self.state["model"]["num_timesteps"]
            print(f"resuming {folder} at step {step} of {config.steps} (stage {self.position.level + 1})")
        elif resume:
            print(f"{folder} holds no checkpoint: starting from the beginning")
        write_json(folder / "config.json", to_json(config))
        self.evaluations = Table(folder / "evaluations.csv", step)
        progress = ProgressTable(Table(folder / "progress.csv", step))
        self.logger = Logger(str(folder), [progress, EventFile(folder / "tensorboard", step)])

    def train(self) -> None:
        """Train the levels that are left, each frozen under the next (paper, Section 4.2)."""
        for level in range(self.position.level, len(self.config.resolutions)):
            model = self._train_level(level)
            last = level + 1 == len(self.config.resolutions)
            if not last:
                best = load(self.folder / "policy.safetensors")
                save_policy(self.folder / f"stage{level + 1}.safetensors", best.actor, best.description)
                self.position = Position(level + 1, self.position.offset + model.num_timesteps)
        self.logger.close()

    def _train_level(self, level: int) -> CFP:
        stage = self.config.stage(level)
        model = self._make_model(level, make_env(self.config, stage.resolution))
        if self.state is not None:
            self.checkpoint.restore(model, self.state)
            self.state = None
        elif level > 0:
            coarse = load(self.folder / f"stage{level}.safetensors", str(model.device)).actor
            model.networks()[0].get_submodule("coarse").load_state_dict(coarse.state_dict())
        ends = (*self.config.handover, self.config.steps)
        left = ends[level] - self.position.offset - model.num_timesteps
        if left > 0:
            callback = self._make_callback(level, model)
            model.learn(left, callback, log_interval=1 << 62, reset_num_timesteps=False)
        return model

    def _make_model(self, level: int, env: VecMonitor) -> CFP:
        stage, learning = self.config.stage(level), self.config.learning
        model = CFP(
            CFPPolicy,
            env,
            learning.learning_rate,
            learning.buffer_size,
            update_start=learning.update_start,
            random_steps=stage.random_steps,
            batch_size=learning.batch_size,
            tau=learning.tau,
            gamma=learning.gamma,
            gradient_steps=learning.gradient_steps,
            alpha=stage.alpha,
            gate_penalty=stage.gate_penalty,
            reward_momentum=learning.reward_momentum,
            max_grad_norm=learning.max_grad_norm,
            precision=learning.precision,
            compile=learning.compile,
            policy_kwargs={"spec": self.config.actor_spec(level)},
            seed=self.config.seed,
            device=choose_device(self.config.device),
            stats_window_size=max(10, env.num_envs),
        )
        model.set_logger(self.logger)
        return model

    def _make_callback(self, level: int, model: CFP) -> StageCallback:
        config, position = self.config, self.position
        episodes = config.report.eval_episodes
        env = make_env(config, config.resolutions[level], episodes)
        actor, _, _ = model.networks()
        rows = read_table(self.folder / "evaluations.csv")
        best = max((float(row["mean"]) for row in rows if int(row["stage"]) == level + 1), default=-math.inf)

        def keep(step: int) -> None:
            save_policy(self.folder / "policy.safetensors", actor, describe(config, level, step))

        def measure(step: int) -> Result:
            nonlocal best
            deterministic = config.report.eval_deterministic
            result = evaluate("", model, env, episodes, deterministic=deterministic, seed=config.seed)
            row: dict[str, Any] = {"step": step, "stage": level + 1, "episodes": episodes}
            row |= {"mean": result.mean, "std": result.std}
            row |= {"lowest": min(result.returns), "highest": max(result.returns), "success": result.success}
            if result.mean > best:  # before the row: a crash between the two repeats the evaluation
                best = result.mean
                keep(step)
            self.evaluations.add(row)
            return result

        def save(step: int) -> None:
            if best == -math.inf:  # not evaluated yet, or never
                keep(step)
            self.checkpoint.save(model, config, position)

        # A level begins with the coarser one's policy under a nearly closed gate: it must do better than that.
        first = level > 0 and config.report.eval_every > 0 and best == -math.inf
        return StageCallback(level, position.offset, config.steps, config.report, self.signals, measure, save, first)

    def finish(self) -> list[Result]:
        """After training: the final table, ``results.json``, the curve and the video. Returns the table's rows."""
        policies = {name: load(path) for name, path in stage_files(self.folder, len(self.config.resolutions)).items()}
        results = compare(self.config, policies, self.config.report.eval_episodes)
        write_json(self.folder / "results.json", to_rows(results))
        untrained = {result.name: result.mean for result in results[:2]}
        print(f"learning curve: {plot_curve(self.folder, self.config, untrained)}")
        if self.config.report.video:
            make_video(self.config, list(policies.values())[-1], self.folder / "video.mp4")
        print(format_table(self.config, results))
        return results

    def last_step(self) -> int:
        """Last step in ``progress.csv``."""
        rows = read_table(self.folder / "progress.csv")
        return int(float(rows[-1]["step"])) if rows else 0


def make_video(config: Config, policy: ActorPolicy, path: Path) -> None:
    """Film one episode of a policy; without the optional packages, say how to get them and go on."""
    try:
        frames = film(config, policy, policy.spec.resolutions[-1], policy.deterministic_by_default)
        write_video(path, frames)
    except VideoUnavailable as error:
        print(error)
    else:
        print(f"video: {path}")
