"""The training run of CFP: one level after another, each frozen under the next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecMonitor

from cfp.algorithm import CFP
from cfp.books import Books
from cfp.callbacks import StageCallback
from cfp.checkpoint import Checkpoint
from cfp.config import Config, SACConfig
from cfp.environments import choose_device, make_env
from cfp.errors import ConfigError
from cfp.estimate import Cost, seconds
from cfp.pictures import policy_pictures
from cfp.policy import ActorPolicy, CFPPolicy, NetworkPolicy
from cfp.replay import FIELDS
from cfp.run import Run
from cfp.state_file import Position
from cfp.weights import describe, fitting, load, policy_for, read_policy, save_policy, single_level_policy, write_policy


class SACRun(Run):
    """Trains `CFP` with whatever networks in its folder; a subclass makes the models and knows their policies."""

    checkpoint_type = Checkpoint
    config: SACConfig
    checkpoint: Checkpoint
    model_type: type[CFP] = CFP

    def build(self, level: int, env: VecMonitor, policy: type[NetworkPolicy], networks: dict[str, Any]) -> CFP:
        """The model of a stage as its options say.

        Args:
            level: Index of the stage.
            env: Where it acts.
            policy: Its networks.
            networks: Their options.
        """
        stage, learning = self.config.stage(level), self.config.learning
        if learning.compile:
            print("compiling the updates; the first time on a machine this takes minutes ...", flush=True)
        model = self.model_type(
            policy,
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
            policy_kwargs=networks,
            seed=self.config.seed,
            device=choose_device(self.config.device),
            stats_window_size=max(10, env.num_envs),
        )
        model.set_logger(self.logger)
        return model

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
        updating = seconds(lambda: model.train(1, model.batch_size)) * self.config.learning.gradient_steps
        arrays = (getattr(buffer, name) for name in FIELDS)
        return Cost((acting + updating) / count, sum(array.nbytes for array in arrays))


class Runner(SACRun):
    """Trains all levels of a ladder in its folder (paper, Section 4.2), see `cfp.run.Run`."""

    config: Config
    warm: ActorPolicy | None = None
    """What the first actor begins with; None if a checkpoint says more."""

    def begin(self) -> Position:
        """Take the first levels from a policy if the options say so; its steps count as those before its handover.

        Raises:
            ConfigError: It is not the first levels of this ladder, or the policy that the first actor shall begin with
                does not fit it.
            CheckpointError: It is missing, damaged, or of another kind.
        """
        if self.config.warm_actor is not None:
            self.warm = single_level_policy(self.config, "warm_actor", self.config.resolutions[0])
        if self.config.start_from is None:
            return Position()
        policy = policy_for(self.config, "start_from")
        levels = len(policy.spec.resolutions)
        if levels >= len(self.config.resolutions) or policy.spec.resolutions != self.config.resolutions[:levels]:
            raise ConfigError(
                f"start_from: got a policy of levels {policy.spec.resolutions}, allowed the first of "
                f"{self.config.resolutions} but the last"
            )
        if levels > 1 and policy.spec != (wanted := self.config.actor_spec(levels - 1)):
            raise ConfigError(f"start_from: got networks {policy.spec}, allowed {wanted}")
        write_policy(self.folder / f"stage{levels}.safetensors", *read_policy(self.config.start_from))
        return Position(levels, self.config.handover[levels - 1])

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
        env = make_env(self.config, self.config.action_size(level))
        model = self.build(level, env, CFPPolicy, {"spec": self.config.actor_spec(level)})
        if level == 0 and self.warm is not None:
            model.networks()[0].load_state_dict(self.warm.actor.state_dict())
        if level > 0:
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
        return load(path)
