"""The training run of CFP: one level after another, each frozen under the next."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecMonitor

from cfp.agent.actor_policy import ActorPolicy
from cfp.agent.hyperparameters import Hyperparameters
from cfp.agent.policies import CFPPolicy, NetworkPolicy
from cfp.agent.sac import CFP
from cfp.config import Config
from cfp.envs.make import choose_device, make_env
from cfp.errors import ConfigError
from cfp.evaluation.pictures import policy_pictures
from cfp.experiment.books import Books
from cfp.experiment.callbacks import StageCallback
from cfp.experiment.checkpoint import Checkpoint
from cfp.experiment.estimate import Cost, seconds
from cfp.experiment.replay_archive import FIELDS
from cfp.experiment.run import Run
from cfp.experiment.state_file import Position
from cfp.weights import describe, fitting, load, policy_for, read_policy, save_policy, write_policy


class SACRun(Run):
    """Trains `CFP` with whatever networks in its folder; a subclass makes the models and knows their policies."""

    checkpoint_type = Checkpoint
    config: Any
    checkpoint: Checkpoint
    model_type: type[CFP] = CFP

    def build(
        self,
        env: VecMonitor,
        policy: type[NetworkPolicy],
        networks: dict[str, Any],
        hyperparameters: Hyperparameters,
    ) -> CFP:
        """Create the model of a stage.

        Args:
            env: Environment to train in.
            policy: Class of the networks.
            networks: Options of the networks.
            hyperparameters: Of the stage.
        """
        if hyperparameters.compile:
            print("compiling the updates; the first time on a machine this takes minutes ...", flush=True)
        model = self.model_type(
            policy,
            env,
            hyperparameters,
            policy_kwargs=networks,
            seed=self.config.seed,
            device=choose_device(self.config.device),
            stats_window_size=max(10, env.num_envs),
        )
        model.set_logger(self.logger)
        return model

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of a stage."""
        hyperparameters: Hyperparameters = self.config.hyperparameters(stage)
        return hyperparameters

    def remarks(self) -> list[str]:
        """Stages that are over before they act by their policy, or before they learn."""
        lines, (starts, waits) = [], (self.config.learning.update_start, self.config.learning.actor_start)
        for level in range(self.position.level, len(self.config.ends())):
            steps, random = self.config.stage_steps(level), self.hyperparameters(level).random_steps
            if steps <= random:
                lines.append(f"stage {level + 1}: all its {steps:,} steps are random (--random-steps {random})")
            elif steps <= starts:
                lines.append(f"stage {level + 1}: no update in its {steps:,} steps (--update-start {starts})")
            elif steps < waits:
                lines.append(f"stage {level + 1}: no actor update in its {steps:,} steps (--actor-start {waits})")
        return lines

    def restore(self, model: CFP, state: dict[str, Any]) -> None:
        """Put the state of a checkpoint into a model that has just been made."""
        self.checkpoint.restore(model, state)

    def save(self, model: CFP) -> None:
        """Write a checkpoint of the model."""
        self.checkpoint.save(model, self.config, self.position)

    def learn(self, model: CFP, steps: int, books: Books) -> None:
        """Train for some more steps in stable-baselines3's loop."""
        callback = StageCallback(books, self.position.offset)
        model.learn(steps, callback, log_interval=1 << 62, reset_num_timesteps=False)

    def measure(self, model: CFP) -> Cost:
        """Time a few steps and updates of a model that has just been made."""
        env, buffer = model.get_env(), model.replay_buffer
        assert env is not None and buffer is not None
        observation, count = env.reset(), env.num_envs
        assert isinstance(observation, np.ndarray)
        model._last_obs = observation
        _, stored = model._sample_action(0, None, count)
        for _ in range(-(-model.batch_size // count)):
            buffer.add(observation, observation, stored, np.zeros(count), np.zeros(count), [{}] * count)
        acting = seconds(lambda: env.step(model.predict(observation)[0]))
        model.num_timesteps = model.hyperparameters.actor_start  # from here on an update is a whole one
        updating = seconds(lambda: model.train(1, model.batch_size)) * self.config.learning.gradient_steps
        arrays = (getattr(buffer, name) for name in FIELDS)
        return Cost((acting + updating) / count, sum(array.nbytes for array in arrays))


class Runner(SACRun):
    """Trains all levels of a ladder in its folder (paper, Section 4.2), see `cfp.experiment.run.Run`."""

    config: Config

    def begin(self) -> Position:
        """Take the first levels from a policy if the options say so; its steps count as those before its handover.

        Raises:
            ConfigError: It does not fit this ladder.
            CheckpointError: It is missing, damaged, or of another kind.
        """
        if self.config.start_from is None:
            return Position()
        policy, refine = policy_for(self.config, self.config.start_from), self.config.refine
        levels, ladder = len(policy.spec.resolutions), self.config.resolutions
        if policy.spec.resolutions != ladder[:levels] or (levels == len(ladder) and not refine):
            allowed = f"the first of {ladder}" + ("" if refine else " but the last")
            raise ConfigError(f"start_from: got a policy of levels {policy.spec.resolutions}, allowed {allowed}")
        if levels > 1 and policy.spec != (wanted := self.config.actor_spec(levels - 1)):
            raise ConfigError(f"start_from: got networks {policy.spec}, allowed {wanted}")
        content = read_policy(self.config.start_from)
        if not refine:
            write_policy(self.folder / f"stage{levels}.safetensors", *content)
            return Position(levels, self.config.handover[levels - 1])
        write_policy(self.start, *content)
        return Position(levels - 1, (0, *self.config.handover)[levels - 1])

    @property
    def start(self) -> Path:
        """The run's own copy of the policy that it refines."""
        return self.folder / "start.safetensors"

    def refines(self, level: int) -> bool:
        """Whether the actor of a level begins as the one in `start`."""
        return self.config.refine and self.start.exists() and read_policy(self.start)[1]["stage"] == level + 1

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of a stage; a policy that is refined does not act at random."""
        own = super().hyperparameters(stage)
        return replace(own, random_steps=0) if self.refines(stage) else own

    def begins_trained(self, level: int) -> bool:
        """Also where a policy is refined."""
        return super().begins_trained(level) or self.refines(level)

    def inherit(self, model: CFP, previous: CFP) -> None:
        """Warm critics: those of the level before, with the reward statistics in whose units they judge."""
        if not self.config.learning.warm_critic:
            return
        for mine, theirs in zip(model.networks()[1:], previous.networks()[1:], strict=True):
            mine.load_state_dict(theirs.state_dict())
        model.reward_statistics.load_state_dict(previous.reward_statistics.state_dict())

    def pictures(self, model: CFP) -> dict[str, np.ndarray]:
        """What the actor does with what the first robot shows."""
        assert isinstance(model._last_obs, np.ndarray)
        observation, _ = model.policy.obs_to_tensor(model._last_obs[:1])
        assert isinstance(observation, torch.Tensor)
        return policy_pictures(model.networks()[0], observation)

    def make_model(self, level: int) -> CFP:
        """Networks, replay memory and environment of a level, over the frozen policy of the coarser one."""
        env, refines = make_env(self.config, self.config.action_size(level)), self.refines(level)
        model = self.build(env, CFPPolicy, {"spec": self.config.actor_spec(level)}, self.hyperparameters(level))
        if refines:
            model.origin = load(self.start, str(model.device)).actor
            model.networks()[0].load_state_dict(model.origin.state_dict())
        elif level > 0:
            path = self.folder / f"stage{level}.safetensors"
            coarse = load(path, str(model.device)).actor
            with fitting(path):
                model.networks()[0].get_submodule("coarse").load_state_dict(coarse.state_dict())
        return model

    def keep(self, model: CFP, level: int, step: int) -> None:
        """Write the actor as ``policy.safetensors``."""
        save_policy(self.folder / "policy.safetensors", model.networks()[0], describe(self.config, level, step))

    def load(self, path: Path) -> ActorPolicy:
        """Load a policy of the run."""
        return load(path, choose_device(self.config.device))
