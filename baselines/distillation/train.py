"""Distillation: the image networks of the coarse-to-fine policy learn what a policy or planner that sees more does."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import nn

import cfp
from baselines.common.episodes import Episodes
from baselines.common.grid import grid_size
from baselines.distillation.config import DistillConfig
from baselines.distillation.dagger import Collector, Dataset, Labels, drop_entries
from baselines.distillation.teacher_training import (
    copy_teacher,
    teacher_path,
    train_teacher,
    warn_of_recorded_teacher,
)
from baselines.distillation.teachers import PlannerTeacher, PolicyTeacher, Teacher, project, read_teacher
from baselines.planning.gradient import GradientPlannerConfig
from baselines.shac.networks import fix_std
from cfp.agent.actor import build_actor
from cfp.agent.actor_policy import ActorPolicy
from cfp.config import RunConfig
from cfp.envs.make import choose_device, make_torch_env
from cfp.errors import NonFiniteError
from cfp.experiment.algorithm import Algorithm, Position, Scalars, Sees
from cfp.experiment.folder import policy_path
from cfp.experiment.process import StopSignals
from cfp.sections import EnvironmentConfig
from cfp.weights import KIND, load, save_policy
from dittogym import make_spec

FINAL_RATE = 0.1
"""Share of the learning rate that is left at the end of its straight decay."""

METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the episodes that ended in the last round, None for none",
    "train/loss": "mean square by which actions differ from the teacher's, mean over the round's updates",
    "train/fresh_loss": "the same on the labels of the round before anything was learned from them, None for no labels",
    "train/share": "share of the round that the teacher led",
    "train/labels": "labels in the data set",
    "train/learning_rate": "Adam's step size",
    "train/episodes": "episodes ended in this stage",
    "train/terminated": "those that ended before their time",
    "train/nonfinite": "simulations that were not finite and were reset",
}
"""Every scalar that `Distill.update` logs, and what it means."""


class Distill(Algorithm):
    """Supervised learning of the teacher's actions in the states that the student gets into.

    The mean action is learned, by least squares after tanh: what differs little in the muscles costs little. The width
    stays about 0.1 before tanh, so that the policy can be evaluated with noise, and refined by soft actor-critic.

    Args:
        config: The run's options.
        stage: Which level, 1 is the coarsest.
        start: Policy of the levels before, which are frozen.
        teacher: File of the teacher's policy, if it is not the one that the options name.
    """

    sees: ClassVar[Sees] = "image"

    def __init__(
        self, config: DistillConfig, stage: int = 1, start: ActorPolicy | None = None, teacher: Path | None = None
    ) -> None:
        self.config, self.stage = config, stage
        own = replace(config, environment=config.environment.for_training(config.train_particles))
        self.env = make_torch_env(own, make_spec(config.task).patch)
        self.spec = config.actor_spec(stage)
        with self._luck():
            self.actor = build_actor(self.spec)
        fix_std(self.actor)
        if start is not None:
            self.actor.get_submodule("coarse").load_state_dict(start.actor.state_dict())
        self.actor.to(self.env.device)
        learning = [parameter for parameter in self.actor.parameters() if parameter.requires_grad]
        self.adam = torch.optim.Adam(learning, config.student_learning_rate)
        episodes = Episodes(
            self.env, config.seed + (stage - 1) * config.num_layouts, config.max_episode_steps, config.num_layouts
        )
        grid = self.spec.resolutions[-1]
        self.collector = Collector(
            self.env, self._teacher(own, teacher), episodes, config.switch_every, config.dropout, grid
        )
        self.dataset, self.rounds = Dataset(config.capacity), 0

    @staticmethod
    def preset(task: str, name: str) -> DistillConfig:
        """Defaults of a task, with the networks of the same preset of the coarse-to-fine policy.

        Both teach at the lite tier; ``quick`` is judged there, ``paper`` in the paper's environment. SHAPE MATCH, whose
        episodes are alike and whose actions are fine, gets fewer labels and more, smaller updates.

        Raises:
            ConfigError: No such task or preset.
        """
        base, silhouette = cfp.preset(task, name), task == "shapematch"
        steps = 24_000 if silhouette else 48_000
        return DistillConfig(
            task=task,
            preset=base.preset,
            environment=replace(base.environment, num_envs=16),
            report=replace(base.report, eval_every=steps // 8, checkpoint_every=steps // 16, log_every=1),
            steps=steps,
            handover=(steps // 2,),
            resolutions=base.resolutions,
            gate_bias=base.gate_bias,
            network=base.network,
            teacher="gradient" if silhouette else "shac",
            rollout_steps=30 if silhouette else 64,
            updates=160 if silhouette else 48,
            batch_size=64 if silhouette else 256,
            student_noise=not base.report.eval_deterministic,
            student_learning_rate=2e-3 if silhouette else 1e-3,
            beta_decay=0.8 if silhouette else 0.7,
            dropout=0.2,
            planner=GradientPlannerConfig(iterations=30, learning_rate=0.1) if silhouette else GradientPlannerConfig(),
            planner_grid=16 if silhouette else "coarse",
        )

    @classmethod
    def initialize(cls, config: DistillConfig, folder: Path) -> Position:
        """Copy the teacher into the folder, if it is a policy."""
        copy_teacher(config, folder)
        return Position()

    @classmethod
    def prepare(cls, config: DistillConfig, folder: Path, signals: StopSignals) -> None:
        """Train the teacher, if only its algorithm is named."""
        train_teacher(config, folder, signals)

    @classmethod
    def create(cls, config: DistillConfig, stage: int, folder: Path, resumed: bool = False) -> Distill:
        """The student at the beginning of a stage."""
        start = load(policy_path(folder, stage - 1), choose_device(config.device)) if stage > 1 else None
        algorithm = cls(config, stage, start, None if config.teacher == "mpc" else teacher_path(folder))
        algorithm.starts_trained = stage > 1
        return algorithm

    @classmethod
    def warnings(cls, config: DistillConfig, folder: Path, first_stage: int) -> list[str]:
        """A teacher that may know one start only."""
        return warn_of_recorded_teacher(config, folder)

    @contextmanager
    def _luck(self) -> Iterator[None]:
        """Torch's generator, seeded for what happens next and put back afterwards."""
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            source = np.random.SeedSequence((self.config.seed, self.stage - 1, self.num_timesteps))
            torch.manual_seed(int(source.generate_state(1)[0]))
            yield

    def _teacher(self, own: RunConfig, path: Path | None) -> Teacher:
        config = self.config
        if path is None and config.teacher == "mpc":
            size = grid_size(config.task, config.planner_grid)
            return PlannerTeacher(make_torch_env(own, size), config.planner, config.seed)
        policy = read_teacher(path or config.teacher, config.task, config.environment)
        theirs = EnvironmentConfig(**policy.description["environment"])
        return PolicyTeacher(policy, theirs.action_indexing, config.environment.action_indexing)

    @property
    def policy(self) -> ActorPolicy:
        """What has been learned so far."""
        policy = ActorPolicy(self.spec, self.config.report.eval_deterministic)
        policy.actor.load_state_dict(self.actor.state_dict())
        return policy.to(self.env.device)

    def attached(self, env: Any) -> ActorPolicy:
        """What has been learned so far; it looks at images only, whatever ``env`` is. Built once, not in every step."""
        return self.policy

    def update(self) -> Scalars:
        """Do one round: collect labels, and learn from all that are kept.

        Raises:
            NonFiniteError: The loss is not finite.
        """
        with self._luck():
            scalars = self._round()
        self.num_timesteps += self.config.rollout_steps * self.env.num_envs
        return scalars

    def _round(self) -> dict[str, float | None]:
        config, share = self.config, self.config.beta_decay**self.rounds
        student = partial(self.actor, deterministic=not config.student_noise)
        labels = self._kept(self.collector.collect(config.rollout_steps, share, student))
        self.dataset.add(labels)
        self.rounds += 1
        with torch.no_grad():
            part = slice(0, None, max(1, len(labels.actions) // config.batch_size))
            # A round may lie within a plan that the student does not follow: then nothing in it was labelled.
            labelled = len(labels.actions) > 0
            fresh = float(self._loss(labels.observations[part], labels.actions[part])) if labelled else None
        rate = self._rate()
        self.adam.param_groups[0]["lr"] = rate
        losses = [self._improve() for _ in range(config.updates)]
        return self.collector.episodes.scalars() | {
            "train/loss": sum(losses) / len(losses),
            "train/fresh_loss": fresh,
            "train/share": share,
            "train/labels": float(len(self.dataset)),
            "train/learning_rate": rate,
        }

    def _kept(self, labels: Labels) -> Labels:
        """Labels as they are kept: on the whole patch an action takes more than an image."""
        size = self.spec.action_size
        if labels.actions.shape[-1] <= size:
            return labels
        return labels._replace(actions=project(labels.actions, size, self.env.spec.patch))

    def _rate(self) -> float:
        bounds = (0, *self.config.ends())
        done = self.num_timesteps / (bounds[self.stage] - bounds[self.stage - 1])
        return self.config.student_learning_rate * (1.0 - (1.0 - FINAL_RATE) * min(done, 1.0))

    def _loss(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Mean square difference of the mean action from the teacher's, both on the grid that is carried out."""
        device, size = self.env.device, self.spec.action_size
        wanted = project(actions.to(device), size, self.env.spec.patch)
        return (self.actor(observations.to(device), deterministic=True) - wanted).square().mean()

    def _improve(self) -> float:
        labels = self.dataset.sample(self.config.batch_size)
        loss = self._loss(drop_entries(labels.observations, self.config.dropout), labels.actions)
        if not math.isfinite(value := float(loss.detach())):
            raise NonFiniteError(
                f"the loss became {value} after {self.num_timesteps} environment steps of the stage; "
                "the last checkpoint is untouched"
            )
        self.adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.adam.param_groups[0]["params"], self.config.max_grad_norm)
        self.adam.step()
        return value

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the policy, as one of CFP."""
        save_policy(
            path, self.actor, description | {"kind": KIND, "network": asdict(self.spec), "trained_by": self.config.algo}
        )

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> ActorPolicy:
        """Load a policy."""
        return load(path, device)

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimiser, labels, episodes in progress and the teacher's plans."""
        return {
            "actor": self.actor.state_dict(),
            "adam": self.adam.state_dict(),
            "dataset": self.dataset.state_dict(),
            "collector": self.collector.state_dict(),
            "rounds": self.rounds,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        for name in ("actor", "adam", "dataset", "collector"):
            getattr(self, name).load_state_dict(state[name])
        self.rounds = state["rounds"]
