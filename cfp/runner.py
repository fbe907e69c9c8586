"""The training run of CFP: one level after another, each frozen under the next."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecMonitor

from cfp.algorithm import CFP
from cfp.books import Books
from cfp.callbacks import StageCallback
from cfp.checkpoint import Checkpoint
from cfp.config import Config
from cfp.environments import choose_device, make_env
from cfp.errors import ConfigError
from cfp.estimate import Cost, seconds
from cfp.policy import ActorPolicy, CFPPolicy
from cfp.replay import FIELDS
from cfp.run import Run
from cfp.state_file import Position
from cfp.weights import describe, load, read_policy, save_policy, write_policy


class Runner(Run):
    """Trains all levels of a ladder in its folder (paper, Section 4.2), see `cfp.run.Run`."""

    checkpoint_type = Checkpoint
    config: Config
    checkpoint: Checkpoint

    def begin(self) -> Position:
        """Take the first levels from a policy if the options say so; its steps count as those before its handover.

        Raises:
            ConfigError: It is not the first levels of this ladder.
            CheckpointError: It is missing, damaged, or of another kind.
        """
        if self.config.start_from is None:
            return Position()
        policy, refine = load(self.config.start_from), self.config.refine
        levels, ladder = len(policy.spec.resolutions), self.config.resolutions
        if policy.description["task"] != self.config.task:
            raise ConfigError(f"start_from: got a policy for {policy.description['task']}, allowed {self.config.task}")
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

    def make_model(self, level: int) -> CFP:
        """Networks, replay memory and environment of a level, over the frozen policy of the coarser one."""
        refines = self.refines(level)
        model = self._make_model(level, make_env(self.config, self.config.action_size(level)), refines)
        if refines:
            model.origin = load(self.start, str(model.device)).actor
            model.networks()[0].load_state_dict(model.origin.state_dict())
        elif level > 0:
            coarse = load(self.folder / f"stage{level}.safetensors", str(model.device)).actor
            model.networks()[0].get_submodule("coarse").load_state_dict(coarse.state_dict())
        return model

    def _make_model(self, level: int, env: VecMonitor, refines: bool) -> CFP:
        stage, learning = self.config.stage(level), self.config.learning
        if learning.compile:
            print("compiling the updates; the first time on a machine this takes minutes ...", flush=True)
        model = CFP(
            CFPPolicy,
            env,
            learning.learning_rate,
            learning.buffer_size,
            update_start=learning.update_start,
            random_steps=0 if refines else stage.random_steps,
            batch_size=learning.batch_size,
            tau=learning.tau,
            gamma=learning.gamma,
            gradient_steps=learning.gradient_steps,
            alpha=stage.alpha,
            gate_penalty=stage.gate_penalty,
            reward_momentum=learning.reward_momentum,
            max_grad_norm=learning.max_grad_norm,
            actor_rate=learning.actor_rate,
            actor_start=learning.actor_start,
            anchor=learning.anchor if refines else 0.0,
            precision=learning.precision,
            compile=learning.compile,
            policy_kwargs={"spec": self.config.actor_spec(level)},
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

    def keep(self, model: CFP, level: int, step: int) -> None:
        """Write the actor as ``policy.safetensors``."""
        save_policy(self.folder / "policy.safetensors", model.networks()[0], describe(self.config, level, step))

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
        actions = np.stack([env.action_space.sample() for _ in range(count)])
        for _ in range(-(-model.batch_size // count)):
            buffer.add(observation, observation, actions, np.zeros(count), np.zeros(count), [{}] * count)
        acting = seconds(lambda: env.step(model.predict(observation)[0]))
        updating = seconds(lambda: model.train(1, model.batch_size)) * self.config.learning.gradient_steps
        arrays = (getattr(buffer, name) for name in FIELDS)
        return Cost((acting + updating) / count, sum(array.nbytes for array in arrays))

    def load(self, path: Path) -> ActorPolicy:
        """Load a policy of the run."""
        return load(path)
