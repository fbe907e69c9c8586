"""Modular policies: one action for each segment of the robot, trained by soft actor-critic like CFP."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, cast, get_args

from stable_baselines3.common.vec_env import VecMonitor

from baselines.modular.env import SegmentedEnv
from baselines.modular.networks import Kind, ModularActor, ModularCritics, SegmentPolicy
from baselines.modular.nodes import Nodes
from cfp.agent.hyperparameters import Hyperparameters, LearningConfig
from cfp.agent.policies import NetworkPolicy
from cfp.config import RunConfig, scale_start
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import TorchVecEnv
from cfp.errors import ConfigError
from cfp.experiment.algorithm import Sees
from cfp.experiment.sac_learner import SACAlgorithm
from cfp.presets import sac_preset
from cfp.validation import check_at_least
from dittogym import make_spec


@dataclass(frozen=True)
class ModularConfig(RunConfig):
    """A run of a modular policy; ``algo`` names its network and the number of segments of the robot."""

    algo: str = "gnn-16"
    """Which algorithm."""
    steps: int = 20_000
    """Environment steps of all robots together."""
    random_steps: int = 500
    """Uniformly random environment steps at the start."""
    alpha: float = 0.01
    """Entropy temperature."""
    max_episode_steps: int | None = None
    """Steps after which training episodes are truncated, if the task's horizon is not shorter; robots begin at
    different ages. None: the horizon, and all begin together."""
    learning: LearningConfig = field(default_factory=LearningConfig)

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)

    @property
    def kind(self) -> Kind:
        """Kind of the networks."""
        return cast(Kind, self.algo.split("-")[0])

    @property
    def segments(self) -> int:
        """Number of segments."""
        return int(self.algo.split("-")[1])

    @property
    def nodes(self) -> Nodes:
        """Features and actions of the segments."""
        return Nodes(self.segments, self.kind == "gnn")

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends."""
        return (self.steps,)

    def resolution(self, stage: int) -> int:
        """Action grid R: the task's whole patch, so that segments write to its nodes."""
        return make_spec(self.task).patch

    def with_derived(self, base: RunConfig, given: Collection[str]) -> RunConfig:
        """Scale the start of the actor's updates, if there are fewer steps."""
        assert isinstance(base, ModularConfig)
        return replace(self, learning=scale_start(self.learning, base.learning, self.steps / base.steps, given))

    def ineffective(self) -> dict[str, str]:
        """Options of several stages, and of grids of actions, have no effect: segments act on nodes."""
        names = ("anchor", "noise_cells", "noise_scale")
        needs = dict.fromkeys((*(f"learning.{name}" for name in names), "environment.action_layout"), "algo cfp")
        return super().ineffective() | needs

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of the only stage."""
        own = vars(self.learning) | {"noise_cells": 0}  # which the options common to a comparison may hold
        return Hyperparameters(**own, alpha=self.alpha, random_steps=self.random_steps)

    def check(self) -> None:
        """Check what the types do not express."""
        kind, _, count = self.algo.partition("-")
        if kind not in get_args(Kind) or not count.isdecimal() or int(count) < 2:
            raise ConfigError(
                f"algo must be gnn or transformer with a number of segments, such as gnn-16, got {self.algo!r}"
            )
        super().check()
        check_at_least(1, steps=self.steps)
        check_at_least(0, random_steps=self.random_steps, alpha=self.alpha)
        if self.max_episode_steps is not None:
            check_at_least(1, max_episode_steps=self.max_episode_steps)
        particles = self.environment.particles
        robot = particles[0] if isinstance(particles, tuple) else particles
        if isinstance(robot, int) and robot < self.segments:
            raise ConfigError(f"particles of the robot must be at least {self.segments}, one per segment, got {robot}")


class ModularPolicy(NetworkPolicy):
    """Actor and critics over segments, for `cfp.agent.sac.CFP`; observes rows (K, columns) of `Nodes`."""

    def __init__(self, *arguments: Any, kind: Kind, features: int, **options: Any) -> None:
        self.kind, self.features = kind, features
        super().__init__(*arguments, **options)

    def new_actor(self) -> ModularActor:
        """An actor."""
        return ModularActor(self.kind, self.features)

    def new_critic(self) -> ModularCritics:
        """Twin critics."""
        return ModularCritics(self.kind, self.features)


class Modular(SACAlgorithm):
    """A modular policy, trained by soft actor-critic."""

    sees: ClassVar[Sees] = "state"
    config: ModularConfig

    @staticmethod
    def preset(task: str, name: str) -> ModularConfig:
        """The environment, learning and temperature of the first stage of `cfp.preset`, for all its steps."""
        base = sac_preset(task, name)
        return ModularConfig(
            task=task,
            preset=base.preset,
            environment=base.environment,
            report=base.report,
            max_episode_steps=base.max_episode_steps,
            learning=replace(
                base.learning,
                noise_cells=0,
                gradient_steps=min(4, base.learning.gradient_steps),
                actor_start=min(800, base.learning.actor_start),
            ),
            steps=base.steps,
            random_steps=base.random_steps[0],
            alpha=base.alpha[0],
        )

    @classmethod
    def create(cls, config: ModularConfig, stage: int, folder: Path) -> Modular:
        """The algorithm at the beginning of its only stage."""
        env = SegmentedEnv(make_torch_env(config, config.resolution(stage)), config.nodes)
        networks = {"kind": config.kind, "features": config.nodes.num_features(env.env.spec)}
        monitor = VecMonitor(TorchVecEnv(env, env.spaces, config.max_episode_steps))
        return cls(config, stage, monitor, ModularPolicy, networks, cls.hyperparameters(config, stage, folder))

    @property
    def policy(self) -> SegmentPolicy:
        """What has been learned so far; it must be attached to an environment."""
        return self._policy({"resolution": self.config.resolution(self.stage)})

    def _policy(self, description: dict[str, Any]) -> SegmentPolicy:
        return SegmentPolicy(cast(ModularActor, self.model.trained_actor), self.config.nodes, description)

    def save_policy(self, path: Path, description: dict[str, Any]) -> None:
        """Write the actor."""
        self._policy(description).save(path)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> SegmentPolicy:
        """Load a policy."""
        return SegmentPolicy.load(path, device)
