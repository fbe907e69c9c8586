"""Distillation: the image networks of the coarse-to-fine policy imitate a policy or planner that sees more."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from baselines.common.grid import long_dt
from baselines.distillation import teachers
from baselines.distillation.config import DistillConfig
from baselines.distillation.dagger import Collector, Dataset, Labels, drop_entries
from baselines.distillation.teachers import PlannerTeacher, PolicyTeacher, Teacher, project, read_teacher
from baselines.planning.mpc import planner_preset
from cfp.agent.actor import Actor, build_actor
from cfp.analytic.critic import descend
from cfp.analytic.window import Episodes
from cfp.envs.make import choose_device, make_env, make_torch_env
from cfp.envs.seeding import seeded
from cfp.errors import NonFiniteError
from cfp.experiment.folder import policy_path
from cfp.experiment.process import StopSignals
from cfp.learner import CoarseToFine, NetworksPolicy, Resumable, UpdateLoop, copy_coarse_weights, linear_decay
from cfp.policy import load
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


class Distill(Resumable, UpdateLoop, CoarseToFine):
    """Supervised learning of the teacher's actions in the states that the student visits, by DAgger.

    The mean action is learned, by least squares after tanh: small differences in the muscles cost little. The standard
    deviation stays 0.105 before tanh, so that the policy can be evaluated with noise, and refined by soft actor-critic.

    Its arguments are those of `cfp.learner.UpdateLoop`.
    """

    config: DistillConfig
    parts, values = ("actor", "adam", "dataset", "collector"), ("rounds",)

    teacher_file: Path | None = None
    """File of the teacher's policy, if it is not the one that the options name."""

    def _setup_model(self) -> None:
        config = self.config
        self.spec = config.actor_spec(self.stage)
        with self._seeded():
            self.actor = build_actor(self.spec)
        self.actor.fix_std()
        self.actor.to(self.simulation.device)
        self.adam = torch.optim.Adam(self.actor.trainable_parameters(), config.student_learning_rate)
        self.policy = NetworksPolicy(self.observation_space, self.action_space, self.actor)
        self.begin_episodes()

    def begin_episodes(self) -> None:
        """Start new episodes in all elements of the simulation, and forget all labels."""
        config = self.config
        seed = config.seed + (self.stage - 1) * config.num_layouts
        episodes = Episodes(self.simulation, seed, config.max_episode_steps, config.num_layouts)
        guide, grid = self._make_teacher(), self.spec.resolutions[-1]
        self.collector = Collector(guide, episodes, config.switch_every, config.dropout, grid)
        self.dataset, self.rounds = Dataset(config.capacity), 0
        self._last_obs = self.simulation.observation().cpu().numpy()

    def _make_teacher(self) -> Teacher:
        config = self.config
        if self.teacher_file is None and config.teacher == "mpc":
            cheap = config.for_training().simulated_with(dt=long_dt(config.task))
            model = make_torch_env(cheap, config.planner_resolution)
            return PlannerTeacher(model, config, config.seed)
        policy = read_teacher(self.teacher_file or config.teacher, config.task, config.environment)
        return PolicyTeacher(policy, config.action_layout)

    def _seeded(self) -> AbstractContextManager[None]:
        """Seed torch's generators by run, stage and step, and restore them afterwards."""
        source = np.random.SeedSequence((self.config.seed, self.stage - 1, self.num_timesteps))
        return seeded(int(source.generate_state(1)[0]))

    def update(self) -> bool:
        """Collect the labels of a round, and learn from all; False if a callback stops the training.

        Raises:
            NonFiniteError: The loss is not finite.
        """
        config, beta = self.config, self.config.beta_decay**self.rounds
        progress = self.progress
        learning_rate = config.student_learning_rate * linear_decay(progress)
        self.adam.param_groups[0]["lr"] = learning_rate
        with self._seeded():
            student = partial(self.actor, deterministic=not config.student_noise)
            collected = self.collector.collect(config.rollout_steps, beta, student, self.after_step)
            self._callback.on_rollout_end()
            if collected is None:
                return False
            labels = self._on_smaller_grid(collected)
            self.dataset.add(labels)
            fresh_loss = self._fresh_loss(labels)
            losses = [self._gradient_step() for _ in range(config.updates)]
        self.rounds += 1
        own = {
            "train/loss": sum(losses) / len(losses),
            "train/fresh_loss": fresh_loss,
            "train/beta": beta,
            "train/labels": float(len(self.dataset)),
            "train/learning_rate": learning_rate,
        }
        self.record(self.collector.episodes.scalars() | own)
        return True

    def _on_smaller_grid(self, labels: Labels) -> Labels:
        """Labels on the student's grid where that is smaller: on the whole patch an action is larger than an image."""
        size = self.spec.action_size
        if labels.actions.shape[-1] <= size:
            return labels
        return labels._replace(actions=project(labels.actions, size, self.simulation.spec.patch))

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
        target = project(actions.to(self.simulation.device), self.spec.action_size, self.simulation.spec.patch)
        return (self.actor(observations.to(self.simulation.device), deterministic=True) - target).square().mean()

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
            **(vars(planner) | vars(base.environment) | {"num_envs": 16}),
            task=task,
            preset=base.preset,
            eval_every=steps // 8,
            checkpoint_every=steps // 16,
            eval_deterministic=base.eval_deterministic,
            log_every=1,
            steps=steps,
            handover=(0.5,),
            resolutions=base.resolutions,
            gate_bias=base.gate_bias,
            interpolation=base.interpolation,
            split=base.split,
            gate_scale=base.gate_scale,
            student_noise=not base.eval_deterministic,
            dropout=0.2,
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
    def begin(cls, config: DistillConfig, folder: Path) -> tuple[int, int]:
        """Copy the teacher into the folder, if it is a policy."""
        teachers.copy_teacher(config, folder)
        return 1, 0

    @classmethod
    def prepare(cls, config: DistillConfig, folder: Path, signals: StopSignals) -> None:
        """Train the teacher, if only its algorithm is named."""
        teachers.train_teacher(config, folder, signals)

    @classmethod
    def create(cls, config: DistillConfig, stage: int, folder: Path) -> Distill:
        """The student at the beginning of a stage."""
        env = make_env(config.for_training(), make_spec(config.task).patch)
        device = choose_device(config.device)
        learner = cls("NetworksPolicy", env, config, stage, device, _init_setup_model=False)
        learner.teacher_file = None if config.teacher == "mpc" else teachers.teacher_path(folder)
        learner._setup_model()
        if stage > 1:
            copy_coarse_weights(learner.actor, load(policy_path(folder, stage - 1), device).actor)
        learner.starts_trained = stage > 1
        return learner

    @classmethod
    def warnings(cls, config: DistillConfig, folder: Path, first_stage: int) -> list[str]:
        """A warning if the teacher was planned for one start only."""
        return teachers.warnings(config, folder)
