"""The learner: windows of simulation, a step on their actions, regression of the actor, and a critic.

The policy sees the image only. The critic sees the state of the simulation, and is needed in training only.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from cfp.agent.actor import Actor, build_actor
from cfp.analytic.action_step import BOUND, ActionStep
from cfp.analytic.config import AnalyticConfig
from cfp.analytic.critic import Critic, mlp
from cfp.analytic.features import StateFeatures
from cfp.analytic.regression import ImageMemory, Regression
from cfp.analytic.stateful import Stateful
from cfp.analytic.window import WINDOW_METRICS, Window, WindowCollector, reward_warnings, short_horizon_loss
from cfp.envs.make import choose_device, make_torch_env
from cfp.envs.seeding import seeded
from cfp.errors import NonFiniteError
from cfp.evaluation.page import policy_pictures
from cfp.experiment.algorithm import Scalars
from cfp.experiment.schedules import linear_decay
from cfp.experiment.stages import CoarseToFineStages, refines
from cfp.presets import analytic_preset

#: Every scalar that ``AnalyticLearner.update`` logs, and what it means.
METRICS: dict[str, str] = {
    **WINDOW_METRICS,
    "train/critic_loss": "mean squared error of the critic in the last of its updates",
    "train/regression_loss": "mean squared error of mean actions and gate logits in the last step of the regression",
    "train/action_step": "root mean square of the step on the actions",
    "train/learning_rate": "Adam's step size",
    "train/limited": "gradients of single actions that were shortened as outliers",
}
#: Training stops after so many windows in a row without any gradient.
MOST_EMPTY_WINDOWS = 10


class AnalyticLearner(Stateful, CoarseToFineStages):
    """Learns a stage of the coarse-to-fine policy by gradients through the simulation.

    Each update rolls out a window (SHAC), takes a normalised gradient step on its actions and regresses the actor onto
    the result (PODS), and trains a privileged critic that values the window's end (SHAC, D.Va).
    """

    config: AnalyticConfig
    parts = ("regression", "memory", "critic", "collector", "action_step")
    values = ("generator", "empty_windows")
    presets = ("quick",)

    def __init__(self, config: AnalyticConfig, stage: int, actor: Actor) -> None:
        self.config, self.stage = config, stage
        self.env = make_torch_env(config.for_training(), config.action_size(stage))
        actor.fix_std()
        self.actor = actor
        self.regression = Regression(actor, config.learning_rate, config.weight_average, config.max_grad_norm)
        features = StateFeatures(displacement=config.displacement)
        with seeded(config.seed):
            critic = mlp(features.size(len(self.env.spec.bodies) - 1), 1).to(self.env.device)
        self.critic = Critic(critic, config)
        self.collector = WindowCollector(self.env, lambda: features(self.env).float(), config)
        self.action_step = ActionStep()
        self.empty_windows = 0
        self.generator = torch.Generator().manual_seed(config.seed)  # on the CPU, so that a run can change its device
        image = self.env.observation()
        with torch.no_grad():
            outputs = actor.outputs(image, deterministic=True, generator=self.generator)
        example = (image[0], outputs.location[0])
        self.memory = ImageMemory(config.windows_kept * config.update_every, example)

    @staticmethod
    def preset(task: str, name: str) -> AnalyticConfig:
        """Default options for a task, see `cfp.preset`."""
        return replace(analytic_preset(task, name), algo="analytic")

    @classmethod
    def create(cls, config: AnalyticConfig, stage: int, folder: Path) -> AnalyticLearner:
        """Networks, memory and environment of a stage."""
        with seeded(config.seed):
            actor = build_actor(config.actor_spec(stage)).to(choose_device(config.device))
        trained = cls.warm_start(config, stage, folder, actor)
        algorithm = cls(config, stage, actor)
        algorithm.starts_trained = trained
        return algorithm

    @classmethod
    def warnings(cls, config: AnalyticConfig, folder: Path, first_stage: int) -> list[str]:
        """Stages that end before their policy learns, and a reward without gradient."""
        lines = [f"{line}; --learner sac learns from rewards alone" for line in reward_warnings(config)]
        warmup = config.warmup * config.update_every
        for stage in range(first_stage, len(config.ends()) + 1):
            starts_trained = stage > 1 or refines(config, folder, stage)
            if starts_trained and (steps := config.stage_steps(stage)) <= warmup:
                option = f"--warmup {config.warmup}"
                lines.append(f"stage {stage}: only the critic learns in its {steps:,} steps ({option})")
        return lines

    @property
    def steps_without_change(self) -> int:
        """Environment steps of the warm-up, in which only the critic of a trained policy learns."""
        return self.config.warmup * self.config.update_every

    def update(self) -> Scalars:
        """Play one window and learn from it.

        Raises:
            NonFiniteError: Actions are not finite, or no gradient of the last windows was.
        """
        config, progress = self.config, self.progress
        learning_rate = config.learning_rate * linear_decay(progress)
        step_size = config.action_step[self.stage - 1] * linear_decay(progress, config.final_step)
        minibatches = config.minibatches
        if self.starts_trained and self.num_timesteps < self.steps_without_change:
            # steps towards the values of an untrained critic, fitted to a few windows, would spoil the policy
            step_size, minibatches = 0.0, 0
        images, improved, window = self._improve(step_size)
        self.memory.add(images, improved.flatten(0, 1))
        regression_loss = torch.zeros(())
        for _ in range(minibatches):
            batch = self.memory.sample(config.minibatch_size, self.generator)
            regression_loss = self.regression.update(*batch, learning_rate)
        critic_loss = self.critic.update(window, learning_rate)
        self.num_timesteps += config.update_every
        return self.collector.scalars(window) | {
            "train/critic_loss": critic_loss,
            "train/regression_loss": float(regression_loss),
            "train/action_step": step_size,
            "train/learning_rate": learning_rate,
            "train/limited": float(self.action_step.limited),
        }

    def _improve(self, step_size: float) -> tuple[Tensor, Tensor, Window]:
        """Simulate a window and take a gradient step on its actions.

        Args:
            step_size: Root mean square of the step; 0: none, and no gradients are computed.

        Returns:
            Images (T B, 3, 64, 64), improved locations (T, B, C, R, R), and the window before the step.
        """
        images: list[Tensor] = []
        leaves: list[Tensor] = []

        def act(_: Tensor) -> Tensor:
            images.append(self.env.observation())
            with torch.no_grad():
                outputs = self.actor.outputs(images[-1], generator=self.generator)
                leaves.append(outputs.location.clamp(-BOUND, BOUND))
            return self.actor.act(outputs.at(leaves[-1].requires_grad_()), generator=self.generator).action

        with torch.set_grad_enabled(step_size > 0):
            window = self.collector.collect(act, self.critic)
        actions = torch.stack(leaves).detach()
        if not step_size:
            return torch.cat(images), actions, window
        gradients = torch.stack(torch.autograd.grad(short_horizon_loss(window, self.config.gamma), leaves))
        self.env.detach()
        self.empty_windows = 0 if gradients.any() else self.empty_windows + 1
        if self.empty_windows >= MOST_EMPTY_WINDOWS:
            raise NonFiniteError(
                f"all gradients of {self.empty_windows} windows in a row are NaN, infinite or 0; a term of the reward "
                f"of {self.config.task} may have no finite derivative, such as the square root at 0"
            )
        improved = self.action_step(actions, gradients, step_size)
        return torch.cat(images), improved, window

    def row(self) -> Scalars:
        """Scalars of the last update, with the mean return of the episodes that ended since the last row."""
        self.collector.episodes.recent_returns = []
        return self.scalars

    def images(self) -> dict[str, np.ndarray]:
        """What the policy does with the observation of the first robot."""
        return policy_pictures(self.trained_actor, self.env.observation()[:1])

    @property
    def trained_actor(self) -> Actor:
        """The actor with averaged weights."""
        return cast(Actor, self.regression.average.module)

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the actor with averaged weights."""
        super().save_policy(path, description | {"trained_by": self.config.learner})
