"""Soft actor-critic as an algorithm of a run, and the learner ``sac`` of the coarse-to-fine policy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecMonitor

from cfp.agent.actor import Actor
from cfp.agent.hyperparameters import Hyperparameters
from cfp.agent.policies import CFPPolicy, NetworkPolicy
from cfp.agent.sac import CFP
from cfp.config import Preset, SACConfig
from cfp.envs.make import choose_device, make_env
from cfp.evaluation.page import policy_pictures
from cfp.experiment.algorithm import Algorithm, Scalars
from cfp.experiment.folder import start_path
from cfp.experiment.sac_state import load_model_state_dict, model_state_dict
from cfp.experiment.stages import CoarseToFineStages, refines
from cfp.policy import load
from cfp.presets import sac_preset

#: Scalars logged beside ``cfp.agent.sac.METRICS`` and ``cfp.experiment.callbacks.LOG_METRICS``.
ROLLOUT_METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the last training episodes (with action noise)",
    "rollout/length": "their mean length in environment steps",
    "rollout/success": "share of successes among them, where the task defines success",
    "rollout/episodes": "episodes finished in this stage",
}


class SACAlgorithm(Algorithm):
    """Trains a `cfp.agent.sac.CFP` with whatever networks; a subclass makes it and knows its policies."""

    presets = get_args(Preset)

    def __init__(
        self,
        config: Any,
        stage: int,
        env: VecMonitor,
        policy: type[NetworkPolicy],
        networks: dict[str, Any],
        hyperparameters: Hyperparameters,
    ) -> None:
        self.config, self.stage = config, stage
        window, device = max(10, env.num_envs), choose_device(config.device)
        options: dict[str, Any] = {"policy_kwargs": networks, "seed": config.seed, "stats_window_size": window}
        self.model = CFP(policy, env, hyperparameters, device=device, **options)
        self.model.set_logger(Logger(None, []))
        self.replay_buffer = self.model.replay_buffer

    @property
    def num_timesteps(self) -> int:
        """Environment steps taken in this stage."""
        return self.model.num_timesteps

    @num_timesteps.setter
    def num_timesteps(self, value: int) -> None:
        self.model.num_timesteps = value

    @property
    def steps_without_change(self) -> int:
        """Environment steps at the beginning of the stage before actor updates (the small encoder learns earlier)."""
        return max(self.model.hyperparameters.actor_start, self.model.hyperparameters.update_start)

    @classmethod
    def hyperparameters(cls, config: Any, stage: int, folder: Path) -> Hyperparameters:
        """Hyperparameters of a stage."""
        return cast(Hyperparameters, config.hyperparameters(stage))

    @classmethod
    def warnings(cls, config: Any, folder: Path, first_stage: int) -> list[str]:
        """Stages that end before they act by their policy, or before they learn."""
        lines = []
        for stage in range(first_stage, len(config.ends()) + 1):
            steps, own = config.stage_steps(stage), cls.hyperparameters(config, stage, folder)
            if steps <= own.random_steps:
                lines.append(f"stage {stage}: all its {steps:,} steps are random (--random-steps {own.random_steps})")
            elif steps <= own.update_start:
                lines.append(f"stage {stage}: no update in its {steps:,} steps (--update-start {own.update_start})")
            elif steps < own.actor_start:
                lines.append(f"stage {stage}: no actor update in its {steps:,} steps (--actor-start {own.actor_start})")
        return lines

    def set_logger(self, logger: Logger) -> None:
        """Set where scalars go."""
        self.logger = logger
        self.model.set_logger(logger)

    def learn(self, total_timesteps: int, callback: BaseCallback | None = None) -> SACAlgorithm:
        """Train for some more environment steps in stable-baselines3's loop."""
        self.model.learn(total_timesteps, callback, log_interval=1 << 62, reset_num_timesteps=False)
        return self

    def row(self) -> Scalars:
        """Scalars of the last episodes; the model has logged its own."""
        episodes, model = self.model.ep_info_buffer or (), self.model
        scalars: dict[str, float | None] = {
            f"rollout/{name}": float(np.mean([float(episode[key]) for episode in episodes])) if episodes else None
            for name, key in (("return", "r"), ("length", "l"))
        }
        scalars["rollout/episodes"] = model._episode_num
        if model.ep_success_buffer:
            scalars["rollout/success"] = float(np.mean(model.ep_success_buffer))
        return scalars

    def state_dict(self) -> dict[str, Any]:
        """All that learning needs to continue."""
        return model_state_dict(self.model)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        load_model_state_dict(self.model, state)


class SACLearner(CoarseToFineStages, SACAlgorithm):
    """Trains the stages of the coarse-to-fine policy from rewards alone, as the paper does."""

    config: SACConfig

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """Default options for a task, see `cfp.preset`."""
        return sac_preset(task, name)

    @classmethod
    def hyperparameters(cls, config: SACConfig, stage: int, folder: Path) -> Hyperparameters:
        """Hyperparameters of a stage; a policy that is refined does not act at random."""
        own = super().hyperparameters(config, stage, folder)
        return replace(own, random_steps=0) if refines(config, folder, stage) else own

    @classmethod
    def create(cls, config: SACConfig, stage: int, folder: Path) -> SACLearner:
        """Networks, replay memory and environment of a stage."""
        spec = config.actor_spec(stage)
        env = make_env(config, config.action_size(stage), max_episode_steps=config.max_episode_steps)
        hyperparameters = cls.hyperparameters(config, stage, folder)
        algorithm = cls(config, stage, env, CFPPolicy, {"spec": spec}, hyperparameters)
        model = algorithm.model
        algorithm.starts_trained = cls.warm_start(config, stage, folder, model.networks()[0])
        model.restart_average()
        if refines(config, folder, stage):
            model.origin = load(start_path(folder), str(model.device)).actor
        return algorithm

    def images(self) -> dict[str, np.ndarray]:
        """What the actor does with the observation of the first robot."""
        observation = torch.as_tensor(np.asarray(self.model._last_obs)[:1], device=self.model.device)
        return policy_pictures(self.trained_actor, observation)

    @property
    def trained_actor(self) -> Actor:
        """The actor that is the policy."""
        return self.model.trained_actor
