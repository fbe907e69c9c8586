"""Modular policies: one action for each segment of the robot, trained by soft actor-critic like CFP."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, cast, get_args

from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.vec_env import VecMonitor

import cfp
from baselines.common.algorithm import Entry
from baselines.common.policies import StateBasedPolicy
from baselines.modular.env import SegmentedEnv
from baselines.modular.networks import Kind, ModularActor, ModularCritics
from baselines.modular.nodes import Nodes
from baselines.modular.policy import SegmentPolicy
from cfp.agent.hyperparameters import Hyperparameters, LearningConfig
from cfp.agent.policies import NetworkPolicy
from cfp.agent.sac import CFP
from cfp.config import RunConfig
from cfp.envs.make import choose_device, make_torch_env
from cfp.envs.vec_env import TorchVecEnv
from cfp.errors import ConfigError
from cfp.experiment.cfp_run import SACRun
from cfp.validation import check_at_least
from cfp.weights import origin
from dittogym import make_spec


@dataclass(frozen=True)
class ModularConfig(RunConfig):
    """A run of a modular policy; ``algo`` says its network and how many segments the robot is cut into."""

    algo: str = "gnn-16"
    """Which algorithm."""
    steps: int = 20_000
    """Environment steps of all robots together."""
    random_steps: int = 500
    """Uniformly random environment steps at the start."""
    alpha: float = 0.01
    """Entropy temperature."""
    learning: LearningConfig = field(default_factory=LearningConfig)

    changeable: ClassVar[tuple[str, ...]] = ("steps", *RunConfig.changeable)

    @property
    def kind(self) -> Kind:
        """Of the networks."""
        return cast(Kind, self.algo.split("-")[0])

    @property
    def segments(self) -> int:
        """How many."""
        return int(self.algo.split("-")[1])

    @property
    def nodes(self) -> Nodes:
        """How segments are seen and act."""
        return Nodes(self.segments, self.kind == "gnn")

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends."""
        return (self.steps,)

    def resolution(self, level: int) -> int:
        """Action grid R: the task's whole patch, so that segments write to its nodes."""
        return make_spec(self.task).patch

    def ineffective(self) -> dict[str, str]:
        """What concerns ladders, and grids of actions: segments act on nodes."""
        needs = dict.fromkeys(("learning.anchor", "learning.warm_critic", "environment.action_layout"), "algo cfp")
        return super().ineffective() | needs

    def hyperparameters(self, stage: int) -> Hyperparameters:
        """Hyperparameters of the only stage."""
        return Hyperparameters(**vars(self.learning), alpha=self.alpha, random_steps=self.random_steps)

    def check(self) -> None:
        """Check what the types cannot, see `RunConfig.check`."""
        kind, _, count = self.algo.partition("-")
        if kind not in get_args(Kind) or not count.isdecimal() or int(count) < 2:
            raise ConfigError(f"algo: got {self.algo!r}, allowed {' or '.join(get_args(Kind))} with a count, as gnn-16")
        super().check()
        check_at_least(1, steps=self.steps)
        check_at_least(0, random_steps=self.random_steps, alpha=self.alpha)
        particles = self.environment.particles
        robot = particles[0] if isinstance(particles, tuple) else particles
        if isinstance(robot, int) and robot < self.segments:
            raise ConfigError(f"particles: got {robot} of the robot, allowed {self.segments} (its segments) or more")


def preset(algo: str, task: str, name: str) -> ModularConfig:
    """The environment, learning and temperature of the first stage of `cfp.preset`, for all its steps.

    Raises:
        ConfigError: No such task or preset.
    """
    ladder = cfp.preset(task, name)
    return ModularConfig(
        algo=algo,
        task=ladder.task,
        preset=ladder.preset,
        seed=ladder.seed,
        environment=ladder.environment,
        report=ladder.report,
        learning=ladder.learning,
        steps=ladder.steps,
        random_steps=ladder.random_steps[0],
        alpha=ladder.alpha[0],
    )


def entry(algo: str) -> Entry:
    """For the registry."""
    return Entry("state", partial(preset, algo), ModularRun, SegmentPolicy.load)


class ModularPolicy(NetworkPolicy):
    """Actor and critics over segments, for `cfp.agent.sac.CFP`.

    Args:
        observation_space: Rows (K, columns) of `Nodes`.
        action_space: (K, 2).
        lr_schedule: See `NetworkPolicy`.
        kind: Of the networks.
        features: Numbers of a row without neighbours.
        options: See `NetworkPolicy`.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        kind: Kind,
        features: int,
        **options: Any,
    ) -> None:
        self.kind, self.features = kind, features
        super().__init__(observation_space, action_space, lr_schedule, **options)

    def new_actor(self) -> ModularActor:
        """One of the kind."""
        return ModularActor(self.kind, self.features)

    def new_critic(self) -> ModularCritics:
        """Two of the kind."""
        return ModularCritics(self.kind, self.features)


class ModularSAC(CFP):
    """`cfp.agent.sac.CFP` on segments."""

    def attached(self, env: Any) -> StateBasedPolicy:
        """The present policy, looking at an environment."""
        assert isinstance(self.policy, ModularPolicy)
        actor = cast(ModularActor, self.networks()[0])
        count = cast(spaces.Box, self.action_space).shape[0]
        return SegmentPolicy(actor, Nodes(count, self.policy.kind == "gnn")).attached(env)


class ModularRun(SACRun):
    """Trains a modular policy in its folder, see `cfp.experiment.run.Run`."""

    config: ModularConfig
    model_type = ModularSAC

    def make_model(self, level: int) -> CFP:
        """Networks, replay memory and environment."""
        env = SegmentedEnv(make_torch_env(self.config, self.config.resolution(level)), self.config.nodes)
        networks = {"kind": self.config.kind, "features": self.config.nodes.num_features(env.env.spec)}
        return self.build(
            VecMonitor(TorchVecEnv(env, env.spaces)), ModularPolicy, networks, self.hyperparameters(level)
        )

    def keep(self, model: CFP, level: int, step: int) -> None:
        """Write the actor as ``policy.safetensors``."""
        actor = cast(ModularActor, model.networks()[0])
        description = origin(self.config, self.config.algo, level, step)
        SegmentPolicy(actor, self.config.nodes, description).save(self.folder / "policy.safetensors")

    def load(self, path: Path) -> SegmentPolicy:
        """Load a policy of the run."""
        return SegmentPolicy.load(path, choose_device(self.config.device))
