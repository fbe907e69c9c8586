"""Distillation: the image networks of the coarse-to-fine policy imitate a policy or planner that sees more."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.distillation import teachers
from baselines.distillation.config import DistillConfig
from baselines.distillation.dagger import Collector, Dataset, Labels, drop_entries
from baselines.distillation.teachers import PlannerTeacher, PolicyTeacher, Teacher, project, read_teacher
from baselines.planning.mpc import planner_preset
from cfp.agent.actor import Actor, build_actor
from cfp.analytic.critic import descend
from cfp.analytic.episodes import Episodes
from cfp.analytic.stateful import Stateful
from cfp.config import RunConfig
from cfp.envs.make import choose_device, make_torch_env
from cfp.envs.seeding import seeded
from cfp.errors import NonFiniteError
from cfp.experiment.algorithm import Position, Scalars
from cfp.experiment.folder import policy_path
from cfp.experiment.process import StopSignals
from cfp.experiment.schedules import linear_decay
from cfp.experiment.stages import CoarseToFineStages, copy_coarse_weights
from cfp.policy import ActorPolicy, load
from cfp.presets import sac_preset
from dittogym import make_spec

#: Every scalar that ``Distill.update`` logs, and what it means.
METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the episodes that ended in the last round; empty if none did",
    "train/loss": "mean squared difference from the teacher's actions, mean over the round's updates",
    "train/fresh_loss": "the same on the labels of the round before the student learned from them, None for no labels",
    "train/beta": "the probability with which the teacher acted in the round",
    "train/labels": "labels in the data set",
    "train/learning_rate": "Adam's step size",
    "train/episodes": "episodes ended in this stage",
    "train/terminated": "training episodes of this stage that terminated early",
    "train/nonfinite": "simulations that were not finite and were reset",
}


class Distill(Stateful, CoarseToFineStages):
    """Supervised learning of the teacher's actions in the states that the student visits, by DAgger.

    The mean action is learned, by least squares after tanh: small differences in the muscles cost little. The standard
    deviation stays 0.105 before tanh, so that the policy can be evaluated with noise, and refined by soft actor-critic.

    Args:
        config: Options of the run.
        stage: Which stage, 1 is the coarsest.
        start: Policy of the coarser stages, which are frozen.
        teacher: File of the teacher's policy, if it is not the one that the options name.
    """

    config: DistillConfig
    parts, values = ("actor", "adam", "dataset", "collector"), ("rounds",)

    def __init__(
        self, config: DistillConfig, stage: int = 1, start: ActorPolicy | None = None, teacher: Path | None = None
    ) -> None:
        self.config, self.stage = config, stage
        training = config.for_training()
        self.env = make_torch_env(training, make_spec(config.task).patch)
        self.spec = config.actor_spec(stage)
        with self._seeded():
            self.actor = build_actor(self.spec)
        self.actor.fix_std()
        if start is not None:
            copy_coarse_weights(self.actor, start.actor)
        self.actor.to(self.env.device)
        self.adam = torch.optim.Adam(self.actor.trainable_parameters(), config.student_learning_rate)
        seed = config.seed + (stage - 1) * config.num_layouts
        episodes = Episodes(self.env, seed, config.max_episode_steps, config.num_layouts)
        guide, grid = self._make_teacher(training, teacher), self.spec.resolutions[-1]
        self.collector = Collector(guide, episodes, config.switch_every, config.dropout, grid)
        self.dataset, self.rounds = Dataset(config.capacity), 0

    def _make_teacher(self, training: RunConfig, path: Path | None) -> Teacher:
        config = self.config
        if path is None and config.teacher == "mpc":
            environment = training.environment.for_optimisation(config.task)
            model = make_torch_env(replace(training, environment=environment), config.planner_resolution)
            return PlannerTeacher(model, config.planner, config.seed)
        policy = read_teacher(path or config.teacher, config.task, config.environment)
        return PolicyTeacher(policy, config.environment.action_indexing)

    def _seeded(self) -> AbstractContextManager[None]:
        """Seed torch's generators by run, stage and step, and restore them afterwards."""
        source = np.random.SeedSequence((self.config.seed, self.stage - 1, self.num_timesteps))
        return seeded(int(source.generate_state(1)[0]))

    def update(self) -> Scalars:
        """Collect the labels of a round, and learn from all; a `NonFiniteError` if the loss is not finite."""
        config, beta = self.config, self.config.beta_decay**self.rounds
        progress = self.progress
        learning_rate = config.student_learning_rate * linear_decay(progress)
        self.adam.param_groups[0]["lr"] = learning_rate
        with self._seeded():
            student = partial(self.actor, deterministic=not config.student_noise)
            labels = self._on_smaller_grid(self.collector.collect(config.rollout_steps, beta, student))
            self.dataset.add(labels)
            fresh_loss = self._fresh_loss(labels)
            losses = [self._gradient_step() for _ in range(config.updates)]
        self.rounds += 1
        self.num_timesteps += config.rollout_steps * self.env.num_envs
        return self.collector.episodes.scalars() | {
            "train/loss": sum(losses) / len(losses),
            "train/fresh_loss": fresh_loss,
            "train/beta": beta,
            "train/labels": float(len(self.dataset)),
            "train/learning_rate": learning_rate,
        }

    def _on_smaller_grid(self, labels: Labels) -> Labels:
        """Labels on the student's grid where that is smaller: on the whole patch an action is larger than an image."""
        size = self.spec.action_size
        if labels.actions.shape[-1] <= size:
            return labels
        return labels._replace(actions=project(labels.actions, size, self.env.spec.patch))

    @torch.no_grad()
    def _fresh_loss(self, labels: Labels) -> float | None:
        """Loss on about a batch of new labels; None in a round within a plan that no robot followed."""
        if len(labels.actions) == 0:
            return None
        part = slice(0, None, max(1, len(labels.actions) // self.config.batch_size))
        return float(self.loss(labels.observations[part], labels.actions[part]))

    def loss(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Mean squared difference of the student's mean actions from the teacher's, on the grid that is carried out.

        ``observations`` are (B, 3, 64, 64) uint8, the teacher's ``actions`` (B, 2, R, R) on any grid.
        """
        target = project(actions.to(self.env.device), self.spec.action_size, self.env.spec.patch)
        return (self.actor(observations.to(self.env.device), deterministic=True) - target).square().mean()

    def _gradient_step(self) -> float:
        labels = self.dataset.sample(self.config.batch_size)
        loss = self.loss(drop_entries(labels.observations, self.config.dropout), labels.actions)
        if not math.isfinite(value := float(loss.detach())):
            raise NonFiniteError(f"the loss became {value} after {self.num_timesteps} environment steps of the stage")
        self.adam.zero_grad()
        loss.backward()
        descend(self.adam, self.config.max_grad_norm, "student's loss")
        return value

    @property
    def trained_actor(self) -> Actor:
        """The student."""
        return self.actor

    @staticmethod
    def preset(task: str, name: str) -> DistillConfig:
        """Defaults of a task, with the networks of the same preset of the coarse-to-fine policy.

        Both presets teach with lite particles; ``quick`` is evaluated there, ``paper`` in the paper's environment.
        SHAPE MATCH, whose episodes are alike and whose actions are fine, gets fewer labels and more, smaller updates.
        """
        base, shape_match = sac_preset(task, name), task == "shapematch"
        steps = 24_000 if shape_match else 48_000
        planner, grid = planner_preset(task)
        config = DistillConfig(
            task=task,
            preset=base.preset,
            environment=replace(base.environment, num_envs=16),
            report=replace(base.report, eval_every=steps // 8, checkpoint_every=steps // 16, log_every=1),
            steps=steps,
            handover=(steps // 2,),
            resolutions=base.resolutions,
            gate_bias=base.gate_bias,
            network=replace(base.network, encoder="paper"),
            student_noise=not base.report.eval_deterministic,
            dropout=0.2,
            planner=planner,
            planner_grid=grid,
        )
        if not shape_match:
            return config
        return replace(
            config,
            teacher="gradient",
            rollout_steps=30,
            updates=160,
            batch_size=64,
            student_learning_rate=2e-3,
            beta_decay=0.8,
        )

    @classmethod
    def initialize(cls, config: DistillConfig, folder: Path) -> Position:
        """Copy the teacher into the folder, if it is a policy."""
        teachers.copy_teacher(config, folder)
        return Position()

    @classmethod
    def prepare(cls, config: DistillConfig, folder: Path, signals: StopSignals) -> None:
        """Train the teacher, if only its algorithm is named."""
        teachers.train_teacher(config, folder, signals)

    @classmethod
    def create(cls, config: DistillConfig, stage: int, folder: Path) -> Distill:
        """The student at the beginning of a stage."""
        start = load(policy_path(folder, stage - 1), choose_device(config.device)) if stage > 1 else None
        teacher = None if config.teacher == "mpc" else teachers.teacher_path(folder)
        algorithm = cls(config, stage, start, teacher)
        algorithm.starts_trained = stage > 1
        return algorithm

    @classmethod
    def warnings(cls, config: DistillConfig, folder: Path, first_stage: int) -> list[str]:
        """A warning if the teacher was planned for one start only."""
        return teachers.warnings(config, folder)

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy, as one of CFP."""
        super().save_policy(path, description | {"trained_by": self.config.algo})
