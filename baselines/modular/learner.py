"""Modular policies: one action for each segment of the robot, trained by soft actor-critic like CFP."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast, get_args

from stable_baselines3.common.vec_env import VecMonitor

from baselines.modular.networks import Kind, ModularActor, ModularCritics, SegmentPolicy
from baselines.modular.segments import Nodes, SegmentedEnv
from cfp.config import Hyperparameters, LearningConfig, RunConfig
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import TorchVecEnv
from cfp.errors import ConfigError, check_at_least, check_below_one
from cfp.learner import Sees
from cfp.presets import sac_preset
from cfp.sac.learner import SACLearner
from cfp.sac.policies import TwinCriticPolicy
from dittogym import make_spec


@dataclass(frozen=True, kw_only=True)
class ModularConfig(LearningConfig, RunConfig):
    """Options of a modular policy, trained by soft actor-critic."""

    algo: str = "gnn-16"
    """Kind of the networks, gnn or transformer, and number of segments of the robot, such as gnn-16."""
    steps: int = 20_000
    """Environment steps of all robots together."""
    random_steps: int = 500
    """Environment steps with uniformly random actions at the start."""
    alpha: float = 0.01
    """Entropy temperature."""
    max_episode_steps: int | None = None
    """Control steps after which training episodes end, the first ones at staggered times; None: all at the horizon."""
    critics_first: float = 0.0
    """Share of the steps in which only the critics learn."""

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

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of the only stage."""
        own = self.common_hyperparameters() | {"alpha": self.alpha, "random_steps": self.random_steps}
        return Hyperparameters(**own, actor_start=round(self.critics_first * self.steps))

    def check(self) -> None:
        """Check what the types do not express."""
        kind, _, count = self.algo.partition("-")
        if kind not in get_args(Kind) or not count.isdecimal() or int(count) < 2:
            raise ConfigError(
                f"algo must be gnn or transformer with a number of segments, such as gnn-16, got {self.algo!r}"
            )
        super().check()
        check_at_least(1, steps=self.steps)
        check_below_one(critics_first=self.critics_first)
        self.hyperparameters(1).check()
        if self.max_episode_steps is not None:
            check_at_least(1, max_episode_steps=self.max_episode_steps)
        robot = self.particles[0] if isinstance(self.particles, tuple) else self.particles
        if isinstance(robot, int) and robot < self.segments:
            raise ConfigError(f"particles of the robot must be at least {self.segments}, one per segment, got {robot}")


class ModularPolicy(TwinCriticPolicy):
    """Actor and critics over segments, for `cfp.CFP`; observes rows (K, columns) of `Nodes`."""

    def __init__(self, *arguments: Any, kind: Kind, features: int, **options: Any) -> None:
        self.kind, self.features = kind, features
        super().__init__(*arguments, **options)

    def new_actor(self) -> ModularActor:
        """An actor."""
        return ModularActor(self.kind, self.features)

    def new_critic(self) -> ModularCritics:
        """Twin critics."""
        return ModularCritics(self.kind, self.features)


class Modular(SACLearner):
    """A modular policy, trained by soft actor-critic."""

    sees: ClassVar[Sees] = "state"
    config: ModularConfig

    @staticmethod
    def preset(task: str, name: str) -> ModularConfig:
        """The environment, learning and temperature of the first stage of `cfp.preset`, for all its steps."""
        base = sac_preset(task, name)
        report = ("eval_every", "eval_episodes", "eval_deterministic", "checkpoint_every", "log_every")
        own = {option: getattr(base, option) for option in ("task", "preset", "steps", "max_episode_steps", *report)}
        learning = base.common_hyperparameters() | {"gradient_steps": min(4, base.gradient_steps)}
        return ModularConfig(
            **(vars(base.environment) | own | learning),
            random_steps=base.random_steps[0],
            alpha=base.alpha[0],
            critics_first=min(800, base.hyperparameters(1).actor_start) / base.steps,
        )

    @classmethod
    def create(cls, config: ModularConfig, stage: int, folder: Path) -> Modular:
        """The learner at the beginning of its only stage."""
        env = SegmentedEnv(make_torch_env(config, config.resolution(stage)), config.nodes)
        networks = {"kind": config.kind, "features": config.nodes.num_features(env.env.spec)}
        monitor = VecMonitor(TorchVecEnv(env, env.spaces, config.max_episode_steps, stagger=True))
        return cast(Modular, cls.make(config, stage, folder, monitor, ModularPolicy, networks))

    @property
    def trained_policy(self) -> SegmentPolicy:
        """What has been learned so far; it must be attached to an environment."""
        description = {"resolution": self.config.resolution(self.stage)}
        return SegmentPolicy(cast(ModularActor, self.trained_actor), self.config.nodes, description)

    @classmethod
    def load_policy(cls, path: Path, device: str = "cpu") -> SegmentPolicy:
        """Load a policy."""
        return SegmentPolicy.load(path, device)
