"""Soft actor-critic as the learner of a run, and ``cfp-sac``, with which the coarse-to-fine policy learns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecMonitor

from cfp.config import Hyperparameters, Preset, SACConfig
from cfp.envs.make import choose_device, make_env
from cfp.evaluation.page import policy_pictures
from cfp.learner import CoarseToFine, Learner, refines
from cfp.presets import sac_preset
from cfp.sac.algorithm import CFP
from cfp.sac.policies import CFPPolicy, NetworkPolicy

#: Scalars logged beside ``cfp.sac.algorithm.METRICS`` and ``cfp.experiment.callbacks.LOG_METRICS``.
ROLLOUT_METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the last training episodes (with action noise)",
    "rollout/length": "their mean length in environment steps",
    "rollout/success": "share of successes among them, where the task defines success",
    "rollout/episodes": "episodes finished in this stage",
}


class SACLearner(CFP, Learner):
    """Soft actor-critic with whatever networks, as the learner of a run."""

    presets = get_args(Preset)

    @classmethod
    def make(
        cls, config: Any, stage: int, folder: Path, env: VecMonitor, policy: type[NetworkPolicy], networks: Any
    ) -> SACLearner:
        """The learner at the beginning of a stage, with a policy that has ``networks`` as its options."""
        options = {"policy_kwargs": networks, "seed": config.seed, "stats_window_size": max(10, env.num_envs)}
        own = cls.stage_hyperparameters(config, stage, folder)
        learner = cls(policy, env, own, device=choose_device(config.device), **options)
        learner.config, learner.stage = config, stage
        learner.set_logger(Logger(None, []))
        return learner

    @classmethod
    def stage_hyperparameters(cls, config: Any, stage: int, folder: Path) -> Hyperparameters:
        """Hyperparameters of a stage."""
        own: Hyperparameters = config.hyperparameters(stage)
        return own

    @property
    def steps_without_change(self) -> int:
        """Environment steps at the beginning of the stage before actor updates (the small encoder learns earlier)."""
        return max(self.hyperparameters.actor_start, self.hyperparameters.update_start)

    @classmethod
    def warnings(cls, config: Any, folder: Path, first_stage: int) -> list[str]:
        """Stages that end before they act by their policy, or before they learn."""
        lines = []
        for stage in range(first_stage, len(config.ends()) + 1):
            steps, own = config.stage_steps(stage), cls.stage_hyperparameters(config, stage, folder)
            if steps <= own.random_steps:
                lines.append(f"stage {stage}: all its {steps:,} steps are random (--random-steps {own.random_steps})")
            elif steps <= own.update_start:
                lines.append(f"stage {stage}: no update in its {steps:,} steps (--update-start {own.update_start})")
        return lines

    def log_row(self) -> None:
        """Record scalars of the last episodes; those of the updates were recorded by `train`."""
        episodes, record = self.ep_info_buffer or (), self.logger.record
        for name, key in (("return", "r"), ("length", "l")):
            record(f"rollout/{name}", float(np.mean([float(each[key]) for each in episodes])) if episodes else None)
        record("rollout/episodes", self._episode_num)
        if self.ep_success_buffer:
            record("rollout/success", float(np.mean(self.ep_success_buffer)))


class CFPSAC(SACLearner, CoarseToFine):
    """Learns the stages of the coarse-to-fine policy from rewards alone, as the paper does."""

    config: SACConfig

    @staticmethod
    def preset(task: str, name: str) -> SACConfig:
        """Default options for a task, see `cfp.preset`."""
        return sac_preset(task, name)

    @classmethod
    def stage_hyperparameters(cls, config: SACConfig, stage: int, folder: Path) -> Hyperparameters:
        """Hyperparameters of a stage; a policy that is refined does not act at random."""
        own = config.hyperparameters(stage)
        return replace(own, random_steps=0) if refines(config, folder, stage) else own

    @classmethod
    def create(cls, config: SACConfig, stage: int, folder: Path) -> CFPSAC:
        """Networks, replay memory and environment of a stage."""
        env = make_env(config, config.action_size(stage), max_episode_steps=config.max_episode_steps)
        learner = cls.make(config, stage, folder, env, CFPPolicy, {"spec": config.actor_spec(stage)})
        assert isinstance(learner, CFPSAC)
        learner.starts_trained = cls.warm_start(config, stage, folder, learner.networks()[0])
        learner.restart_average()
        learner.trains_encoder = not refines(config, folder, stage)
        return learner

    def images(self) -> dict[str, np.ndarray]:
        """What the actor does with the observation of the first robot."""
        observation = torch.as_tensor(np.asarray(self._last_obs)[:1], device=self.device)
        return policy_pictures(self.trained_actor, observation)
