"""Distillation: the image networks of the coarse-to-fine policy imitate a policy that sees more.

By dataset aggregation (DAgger; Ross et al., AISTATS 2011): the student acts, the teacher labels the visited states.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from baselines.distillation.teachers import Teacher, project, read_teacher
from baselines.registry import configure, find
from cfp.agent.actor import Actor, build_actor
from cfp.analytic.critic import check_norms, descend
from cfp.analytic.window import Episodes
from cfp.config import TASK_OPTIONS, Particles, StagedConfig, check_training_seeds
from cfp.envs.make import choose_device, make_env, seeded
from cfp.errors import CheckpointError, ConfigError, NonFiniteError, check_at_least, check_fraction, check_positive
from cfp.experiment.cli import StopSignals
from cfp.experiment.folder import policy_path
from cfp.experiment.run import TrainingRun
from cfp.hub import is_address
from cfp.learner import CoarseToFine, NetworksPolicy, UpdateLoop, copy_coarse_weights, linear_decay
from cfp.messages import say
from cfp.policy import copy_policy, load, read_policy, shipped
from cfp.presets import sac_preset
from cfp.resumable import Resumable, compress, decompress
from dittogym import TorchEnv, make_spec
from dittogym.conditions import drop
from torchmpm import tree

#: Control steps after which it is drawn anew whether teacher or student acts on a robot.
SWITCH_EVERY = 8
#: Teachers that are trained first if only their algorithm is named.
TRAINED = ("shac", "gradient")

#: Every scalar that ``Distill.update`` logs, and what it means.
METRICS: dict[str, str] = {
    "rollout/return": "mean undiscounted return of the episodes that ended in the last round; empty if none did",
    "train/loss": "mean squared difference from the teacher's actions, mean over the round's updates",
    "train/fresh_loss": "the same on the labels of the round before the student learned from them",
    "train/beta": "the probability with which the teacher acted in the round",
    "train/labels": "labels in the data set",
    "train/learning_rate": "Adam's step size",
    "train/episodes": "episodes ended in this stage",
    "train/terminated": "training episodes of this stage that terminated early",
    "train/nonfinite": "simulations that were not finite and were reset",
}


@dataclass(frozen=True, kw_only=True)
class DistillConfig(StagedConfig):
    """Options of a distillation, in which num_envs robots move side by side.

    The environment options apply to evaluations of the student, train_particles to its training.
    """

    algo: str = "distill"
    """Name of the algorithm."""
    teacher: str = "shac"
    """Teacher: shac or gradient (trained first), or a policy (a run folder or a file)."""
    train_particles: Particles = "lite"
    """Particles of the simulations in training."""
    rollout_steps: int = 64
    """Control steps of each robot in a round, after which the student is updated."""
    updates: int = 48
    """Gradient steps after each round."""
    batch_size: int = 256
    """Labels in a gradient step."""
    student_noise: bool = True
    """Whether the student acts with the noise of its policy."""
    learning_rate: float = 1e-3
    """Adam's step size at the beginning of each stage; it falls to a tenth."""
    max_grad_norm: float = 1.0
    """Largest norm of the gradient."""
    beta_decay: float = 0.7
    """Factor by which beta, the probability that the teacher acts, falls from round to round; it starts at 1."""
    dropout: float = 0.0
    """Probability with which entries are set to 0 in half of the student's observations and actions in training."""
    max_episode_steps: int = 400
    """Control steps after which training episodes end, the first ones at staggered times."""
    num_layouts: int = 64
    """Particle layouts that training episodes start from in turn; in GROW and OBSTACLE all are the same."""

    @property
    def update_every(self) -> int:
        """Environment steps from one update to the next: a round of all robots."""
        return self.rollout_steps * self.num_envs

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        check_at_least(1, rollout_steps=self.rollout_steps, updates=self.updates, batch_size=self.batch_size)
        check_at_least(1, max_episode_steps=self.max_episode_steps, num_layouts=self.num_layouts)
        check_training_seeds("num_layouts", self.num_layouts, self.num_envs, len(self.resolutions))
        check_positive(learning_rate=self.learning_rate, max_grad_norm=self.max_grad_norm)
        check_fraction(beta_decay=self.beta_decay, dropout=self.dropout)


class Labels(NamedTuple):
    """Observations and the teacher's actions."""

    observations: Tensor  # (n, 3, 64, 64) uint8
    actions: Tensor  # (n, 2, R, R) on the teacher's grid, or on the student's where that is smaller


class Dataset:
    """The labels of all rounds: 12 KiB for an image, and 8 R R bytes for an action on the smaller of both grids."""

    def __init__(self) -> None:
        self.rounds: list[Labels] = []
        self._compressed: list[Tensor | None] = []

    def __len__(self) -> int:
        """Number of labels."""
        return sum(len(labels.observations) for labels in self.rounds)

    def add(self, labels: Labels) -> None:
        """Add a round."""
        self.rounds.append(labels)
        self._compressed.append(None)

    def sample(self, count: int) -> Labels:
        """Draw labels uniformly with replacement, from torch's generator."""
        sizes = torch.tensor([len(labels.observations) for labels in self.rounds])
        ends = sizes.cumsum(0)
        picks = torch.randint(int(ends[-1]), (count,))
        rounds = torch.searchsorted(ends, picks, right=True)
        rows = (picks - (ends - sizes)[rounds]).tolist()
        chosen = [(self.rounds[index], row) for index, row in zip(rounds.tolist(), rows, strict=True)]
        return Labels(*(torch.stack([labels[part][row] for labels, row in chosen]) for part in (0, 1)))

    def state_dict(self) -> dict[str, Any]:
        """All labels; the images of each round are compressed once."""
        for index, labels in enumerate(self.rounds):
            if self._compressed[index] is None:
                self._compressed[index] = compress(labels.observations)
        return {"observations": list(self._compressed), "actions": [labels.actions for labels in self.rounds]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self._compressed = list(state["observations"])
        images = [decompress(content, TorchEnv.observation_shape) for content in state["observations"]]
        self.rounds = [Labels(*pair) for pair in zip(images, state["actions"], strict=True)]


def drop_entries(values: Tensor, probability: float, grid: int | None = None) -> Tensor:
    """Set random entries of values (B, ..., A, A) to 0 in half of the elements, drawn on a coarser ``grid`` if any."""
    if not probability:
        return values
    mask = torch.rand(values.shape if grid is None else (*values.shape[:-2], grid, grid)) < probability
    mask &= torch.rand(len(values), *[1] * (values.ndim - 1)) < 0.5
    return drop(values, mask.to(values.device))


class Collector(Resumable):
    """Lets a mixture of student and teacher act, and labels the states by the teacher.

    Who controls a robot is drawn anew every ``switch_every`` steps.
    """

    parts = ("episodes", "teacher")
    values = ("steps_since_switch", "teacher_acts")

    def __init__(
        self, teacher: Teacher, episodes: Episodes, switch_every: int, dropout: float = 0.0, grid: int | None = None
    ) -> None:
        self.env, self.teacher, self.episodes, self.switch_every = episodes.env, teacher, episodes, switch_every
        self.dropout, self.grid = dropout, grid
        self.steps_since_switch = switch_every
        self.teacher_acts = torch.zeros(self.env.num_envs, dtype=torch.bool, device=self.env.device)

    @torch.no_grad()
    def collect(
        self,
        steps: int,
        beta: float,
        student: Callable[[Tensor], Tensor],
        after_step: Callable[[np.ndarray, list[dict[str, Any]]], bool],
    ) -> Labels | None:
        """Act for some control steps and return the labels; None if ``after_step`` returns False.

        The teacher controls a robot with probability ``beta``, drawn from torch's generator; the student maps images
        (B, 3, 64, 64) to actions (B, 2, R, R), and loses entries of both with probability ``dropout``.
        """
        env, images, actions = self.env, [], []
        self.episodes.recent_returns = []
        observation = env.observation()
        for _ in range(steps):
            teacher_action = self.teacher.act(env, observation)
            if self.steps_since_switch >= self.switch_every:
                draws = torch.rand(env.num_envs).to(env.device)
                self.teacher_acts, self.steps_since_switch = draws < beta, 0
            self.steps_since_switch += 1
            images.append(observation.cpu())
            actions.append(teacher_action.cpu())
            student_action = student(drop_entries(observation, self.dropout))
            student_action = self._enlarge(drop_entries(student_action, self.dropout, self.grid))
            teacher_action = self._enlarge(teacher_action)
            _, reward, terminated, _, info = env.step(tree.where(self.teacher_acts, teacher_action, student_action))
            outcome = self.episodes.end_step(reward, terminated, info["finite"])
            observation = env.observation()
            if not after_step(outcome.values["done"], outcome.infos):
                return None
        return Labels(torch.cat(images), torch.cat(actions))

    def _enlarge(self, action: Tensor) -> Tensor:
        return project(action, self.env.action_resolution, self.env.spec.patch)


def teacher_path(folder: Path) -> Path:
    """The copy of the teacher in the folder of a run."""
    return folder / "teacher.safetensors"


class Distill(Resumable, UpdateLoop, CoarseToFine):
    """Teaches the networks of the coarse-to-fine policy to imitate a teacher that sees more than the image.

    This is dataset aggregation (DAgger; Ross et al., AISTATS 2011): student and teacher act, and the teacher labels the
    states that are visited. The student's mean action is fitted to the labels by least squares after tanh, so that
    small differences in the muscles cost little. Its standard deviation stays 0.105 before tanh, so that the policy can
    be evaluated with noise, and refined by soft actor-critic. `baselines.fit` trains all stages.

    Args:
        policy: ``"NetworksPolicy"``.
        env: A `cfp.TorchVecEnv`, in which it is trained. Its actions have the size ``config.action_size(stage)``.
        config: Options, such as those of ``Distill.preset(task, "quick")``; None only where stable-baselines3 loads a
            saved model.
        stage: The stage that it learns, 1 for the coarsest.
        device: Device of the networks, that of the simulation.
        _init_setup_model: Make the networks at once; stable-baselines3 passes False to load a saved model.

    Raises:
        TypeError: ``env`` is not a `cfp.TorchVecEnv`, or ``config`` is None.
        cfp.CheckpointError: The file of the teacher is missing, damaged, or not a policy.
        cfp.ConfigError: The teacher does not go with task, environment or options.
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
        self.actor.to(self.device)
        self.adam = torch.optim.Adam(self.actor.trainable_parameters(), config.learning_rate)
        self.policy = NetworksPolicy(self.observation_space, self.action_space, actor=self.actor)
        if self.env is not None:  # a loaded model can act without one
            self.begin_episodes()

    def begin_episodes(self) -> None:
        """Start new episodes in all elements of the simulation, and forget all labels."""
        config = self.config
        seed = config.seed + (self.stage - 1) * config.num_layouts
        episodes = Episodes(self.simulation, seed, config.max_episode_steps, config.num_layouts)
        policy = read_teacher(self.teacher_file or config.teacher, config.task, config.environment)
        teacher, grid = Teacher(policy, config.action_layout), self.spec.resolutions[-1]
        self.collector = Collector(teacher, episodes, SWITCH_EVERY, config.dropout, grid)
        self.dataset, self.rounds = Dataset(), 0
        self._last_obs = self.simulation.observation().cpu().numpy()

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
        learning_rate = config.learning_rate * linear_decay(progress)
        self.adam.param_groups[0]["lr"] = learning_rate
        with self._seeded():
            collected = self.collector.collect(config.rollout_steps, beta, self._student, self.after_step)
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

    def _student(self, images: Tensor) -> Tensor:
        action: Tensor = self.actor(self.spec.filled(images), deterministic=not self.config.student_noise)
        return action

    def _on_smaller_grid(self, labels: Labels) -> Labels:
        """Labels on the student's grid where that is smaller: on the whole patch an action is larger than an image."""
        size = self.spec.action_size
        if labels.actions.shape[-1] <= size:
            return labels
        return labels._replace(actions=project(labels.actions, size, self.simulation.spec.patch))

    @torch.no_grad()
    def _fresh_loss(self, labels: Labels) -> float:
        """Loss on about a batch of new labels."""
        part = slice(0, None, max(1, len(labels.actions) // self.config.batch_size))
        return float(self.loss(labels.observations[part], labels.actions[part]))

    def loss(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Mean squared difference of the student's mean actions from the teacher's, on the grid that is carried out.

        ``observations`` are (B, 3, 64, 64) uint8, the teacher's ``actions`` (B, 2, R, R) on any grid.
        """
        target = project(actions.to(self.simulation.device), self.spec.action_size, self.simulation.spec.patch)
        images = self.spec.filled(observations.to(self.simulation.device))
        return (self.actor(images, deterministic=True) - target).square().mean()

    def _gradient_step(self) -> float:
        labels = self.dataset.sample(self.config.batch_size)
        loss = self.loss(drop_entries(labels.observations, self.config.dropout), labels.actions)
        if not math.isfinite(value := float(loss.detach())):
            raise NonFiniteError(f"the loss became {value} after {self.num_timesteps} environment steps of the stage")
        self.adam.zero_grad()
        loss.backward()
        check_norms([descend(self.adam, self.config.max_grad_norm)], "student's loss")
        return value

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Any]:
        """Act as `cfp.learner.UpdateLoop.predict` does, on the grid of the algorithm's environment."""
        actions, state = super().predict(observation, state, episode_start, deterministic)
        patch = self.config.make_spec().patch
        return project(torch.from_numpy(actions), patch, patch).numpy(), state

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "adam"], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self.parts, *self.values, "_callback"]

    @property
    def trained_actor(self) -> Actor:
        """The student."""
        return self.actor

    @staticmethod
    def preset(task: str, name: str) -> DistillConfig:
        """Defaults of a task: grids and gates of the same preset of ``cfp-sac``, but always the paper's networks.

        Both presets teach with lite particles; ``quick`` is evaluated there, ``paper`` in the paper's environment.
        SHAPE MATCH, whose episodes are alike and whose actions are fine, gets fewer labels and more, smaller updates.
        """
        base, shape_match = sac_preset(task, name), task == "shapematch"
        steps = 24_000 if shape_match else 48_000
        config = DistillConfig(
            **(vars(base.environment) | {"num_envs": 16}),
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
            fill_missing=base.fill_missing,
            split=base.split,
            gate_scale=base.gate_scale,
            student_noise=not base.eval_deterministic,
            dropout=0.2,
        )
        if not shape_match:
            return config
        return replace(
            config,
            teacher="gradient",
            rollout_steps=30,
            updates=160,
            batch_size=64,
            learning_rate=2e-3,
            beta_decay=0.8,
        )

    @classmethod
    def begin(cls, config: DistillConfig, folder: Path) -> tuple[int, int]:
        """Copy the teacher into the folder, if it is a policy; else remove what an earlier attempt has left there."""
        teacher = config.teacher
        if teacher in TRAINED:
            teacher_path(folder).unlink(missing_ok=True)
            return 1, 0
        try:
            read_teacher(teacher, config.task, config.environment)
        except CheckpointError as error:
            if Path(teacher).exists() or is_address(teacher):
                raise
            names = ", ".join((*TRAINED, *shipped()))
            raise ConfigError(
                f"teacher must be {names}, a run folder or a policy.safetensors, got {teacher!r}"
            ) from error
        copy_policy(teacher, teacher_path(folder))
        return 1, 0

    @classmethod
    def prepare(cls, config: DistillConfig, folder: Path, signals: StopSignals) -> None:
        """Train a teacher of which only the algorithm is named, in the folder ``teacher``."""
        if config.teacher not in TRAINED or teacher_path(folder).exists():
            return
        chosen = configure({"algo": config.teacher, "task": config.task})
        same = {name: getattr(config, name) for name in ("substeps", "dt", "dtype", "backend", *TASK_OPTIONS)}
        chosen = replace(chosen, seed=config.seed, device=config.device, **same)
        algorithm, own = find(config.teacher), folder / "teacher"
        run = TrainingRun(algorithm, chosen, own, True, signals)
        say(f"training the teacher first: {config.teacher} -> {own}")
        run.train()
        copy_policy(policy_path(own), teacher_path(folder))

    @classmethod
    def create(cls, config: DistillConfig, stage: int, folder: Path) -> Distill:
        """The student at the beginning of a stage."""
        env = make_env(config.for_training(), make_spec(config.task).patch)
        device = choose_device(config.device)
        learner = cls("NetworksPolicy", env, config, stage, device, _init_setup_model=False)
        learner.teacher_file = teacher_path(folder)
        learner._setup_model()
        if stage > 1:
            copy_coarse_weights(learner.actor, load(policy_path(folder, stage - 1), device).actor)
        learner.starts_trained = stage > 1
        return learner

    @classmethod
    def warnings(cls, config: DistillConfig, folder: Path, first_stage: int) -> list[str]:
        """A warning if the teacher is the record of one episode, in a task whose episodes start differently."""
        if config.teacher in TRAINED or "layout" not in read_policy(teacher_path(folder))[1]:
            return []
        if config.make_spec().starts_alike:
            return []
        return [
            f"teacher: the record of one planned episode, while every episode of {config.task} starts differently; "
            "evaluate it from other starts (torchmpm evaluate --policy)"
        ]
