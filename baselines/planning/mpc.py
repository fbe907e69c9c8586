"""Planners as algorithms: each plans its way through one episode and keeps what it did."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

import cfp
from baselines.common.algorithm import Algorithm, Callback, GridConfig, Sees
from baselines.common.open_loop import OpenLoop
from baselines.planning.base import Planner, PlannerConfig
from baselines.planning.cem import CEMPlanner, CEMPlannerConfig
from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig
from baselines.planning.surrogate import Reduced
from cfp.config import EnvironmentConfig, ReportConfig, Tier
from cfp.envs.make import make_torch_env
from cfp.errors import ConfigError
from dittogym import make_spec

METRICS: dict[str, str] = {
    "train/return": "sum of the rewards of the episode so far",
    "train/reward": "reward of the last step",
    "train/plans": "plans evaluated so far; each is a simulation of the planner's horizon",
    "train/failed": "plans that were not finite so far; they are never carried out",
}
"""Every scalar that `MPC.learn` logs, and what it means."""


@dataclass(frozen=True)
class PlannedConfig(GridConfig):
    """A planned episode: one robot on the layout of the seed, from the start to the end of the task.

    The environment options say where plans are carried out and judged; tier says where they are tried.
    """

    tier: Tier | None = None
    """Particles of the simulations that plans are tried in, at most the environment's; None: as many."""
    planner: PlanConfig = field(default_factory=PlanConfig)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends, at the latest."""
        return (make_spec(self.task).horizon,)

    def evaluation(self, level: int) -> tuple[int, int]:
        """The episode is evaluated on the layout that it was planned on."""
        return self.seed, 1

    def check(self) -> None:
        """Check what the types cannot, see `RunConfig.check`."""
        super().check()
        self.planner.check()
        if self.environment.num_envs != 1:
            raise ConfigError(f"num_envs: got {self.environment.num_envs}, allowed 1: an episode is planned for itself")
        if self.environment.resample:
            raise ConfigError("resample: got True, allowed False: an episode is planned on one layout")


@dataclass(frozen=True)
class MPCConfig(PlannedConfig):
    """An episode planned by gradients: one robot on the layout of the seed, from the start to the end of the task."""

    algo: str = "mpc"
    """Which algorithm."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)


def planned(task: str, name: str) -> dict[str, Any]:
    """Defaults of a task that do not depend on how plans are found: options by name.

    ``quick`` carries plans out at the lite tier, ``paper`` in the paper's environment; both try them at the lite tier.
    The episode of SHAPE MATCH is short and its reward all detail: it gets an action grid of 16.

    Raises:
        ConfigError: No such task or preset.
    """
    environment = cfp.preset(task, name).environment
    if name == "quick":
        environment = EnvironmentConfig()
    horizon = make_spec(task).horizon
    return {
        "task": task,
        "preset": "quick" if name == "quick" else "paper",
        "environment": replace(environment, num_envs=1),
        "report": ReportConfig(horizon // 4 + 1, 1, True, checkpoint_every=horizon // 20 + 1, log_every=10),
        "grid": 16 if task == "shapematch" else "coarse",
        "tier": None if name == "quick" else "lite",
    }


class MPC(Algorithm):
    """Model predictive control by gradients, see `baselines.Planner`.

    There is nothing to learn: `learn` carries out planned steps of a single episode, and the policy is the record of
    its actions. On the layout of its seed the record repeats the episode; other layouts have to be planned for
    themselves.
    """

    name: ClassVar[str] = "mpc"
    sees: ClassVar[Sees] = "simulator"
    planner_type: ClassVar[type[PlannerBase[Any]]] = Planner

    def __init__(self, config: PlannedConfig, level: int = 0, start: Any = None) -> None:
        self.config = config
        self.env = make_torch_env(config, config.resolution(0), 1)
        self.env.reset(seed=config.seed)
        self.reduced = None if config.tier is None else self._reduced(config, config.tier)
        tried = self.reduced.small if self.reduced else self.env
        self.planner = self.planner_type(tried, config.planner, seed=config.seed)
        self.period = config.planner.commit  # all its planning is in the first of these steps
        self.actions = torch.zeros(0, *self.env.action_shape)
        self.total, self.reward, self.over = 0.0, 0.0, False

    def _reduced(self, config: PlannedConfig, tier: Tier) -> Reduced:
        own = replace(config, environment=config.environment.learned_at(tier))
        small = make_torch_env(own, config.resolution(0), 1)
        small.reset(seed=config.seed)
        try:
            return Reduced(self.env, small)
        except ValueError as error:
            raise ConfigError(f"tier: {error}") from error

    @staticmethod
    def preset(task: str, name: str) -> PlannedConfig:
        """Defaults of a task, see `planned`; SHAPE MATCH gets more and smaller gradient steps.

        Raises:
            ConfigError: No such task or preset.
        """
        planner = PlannerConfig(iterations=30, learning_rate=0.1) if task == "shapematch" else PlannerConfig()
        return MPCConfig(**planned(task, name), planner=planner)

    @property
    def policy(self) -> OpenLoop:
        """The record so far."""
        return OpenLoop(self.actions)

    def learn(self, total_timesteps: int, callback: Callback) -> MPC:
        """Carry out some more steps, fewer if the episode ends."""
        end = self.num_timesteps + total_timesteps
        while self.num_timesteps < end and not self.over:
            if self.reduced and self.planner.due:
                self.reduced.follow(self.env.env_state)
            action = self.planner.act().float()  # as the record keeps it, so that it repeats the episode exactly
            self._carry_out(action)
            self.actions = torch.cat((self.actions, action.cpu()))
            self.num_timesteps += 1
            callback(
                {
                    "train/return": self.total,
                    "train/reward": self.reward,
                    "train/plans": float(self.planner.plans),
                    "train/failed": float(self.planner.failed),
                }
            )
        return self

    @torch.no_grad()
    def _carry_out(self, action: Tensor) -> None:
        _, reward, terminated, _, _ = self.env.step(action)
        self.reward = float(reward)
        self.total += self.reward
        self.over = bool(terminated)

    def save(self, path: Path, description: dict[str, Any]) -> None:
        """Write the record, with its layout."""
        OpenLoop(self.actions, description | {"layout": self.config.seed}).save(path)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> OpenLoop:
        """Load a record."""
        return OpenLoop.load(path)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step depends on; the state of the robot is found by repeating its actions."""
        return {"actions": self.actions, "planner": self.planner.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self.actions = state["actions"]
        for action in self.actions.to(self.env.device):
            self._carry_out(action[None])
        self.planner.load_state_dict(state["planner"])
