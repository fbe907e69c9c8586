"""The gradient planner as an algorithm: it plans its way through one episode and keeps what it did."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

import cfp
from baselines.algorithm import Algorithm, Callback, Sees
from baselines.open_loop import OpenLoop
from baselines.planner import Planner, PlannerConfig
from cfp.config import EnvironmentConfig, ReportConfig, RunConfig
from cfp.environments import make_torch_env
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
class MPCConfig(RunConfig):
    """A planned episode: one robot on the layout of the seed, from the start to the end of the task."""

    algo: str = "mpc"
    """Which algorithm."""
    grid: int | Literal["coarse", "fine"] = "coarse"
    """Action grid R: coarse, fine (the task's), or a number."""
    planner: PlannerConfig = field(default_factory=PlannerConfig)

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends, at the latest."""
        return (make_spec(self.task).horizon,)

    def resolution(self, level: int) -> int:
        """Action grid R."""
        spec = make_spec(self.task)
        return {"coarse": spec.coarse, "fine": spec.fine}[self.grid] if isinstance(self.grid, str) else self.grid

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


class MPC(Algorithm):
    """Model predictive control by gradients, see `baselines.Planner`.

    There is nothing to learn: `learn` carries out planned steps of a single episode, and the policy is the record of
    its actions. On the layout of its seed the record repeats the episode; other layouts have to be planned for
    themselves.
    """

    name: ClassVar[str] = "mpc"
    sees: ClassVar[Sees] = "simulator"

    def __init__(self, config: MPCConfig, level: int = 0, start: Any = None) -> None:
        self.config = config
        self.env = make_torch_env(config, config.resolution(0), 1)
        self.env.reset(seed=config.seed)
        self.planner = Planner(self.env, config.planner, seed=config.seed, layout=config.environment.layout)
        self.period = config.planner.commit  # all its planning is in the first of these steps
        self.actions = torch.zeros(0, *self.env.action_shape)
        self.total, self.reward, self.over = 0.0, 0.0, False

    @staticmethod
    def preset(task: str, name: str) -> MPCConfig:
        """Defaults of a task: ``quick`` plans at the lite tier, ``paper`` in the paper's environment.

        SHAPE MATCH gets more and smaller gradient steps: its episode is short and its reward all detail.

        Raises:
            ConfigError: No such task or preset.
        """
        environment = cfp.preset(task, name).environment
        if name == "quick":
            environment = EnvironmentConfig()
        horizon, silhouette = make_spec(task).horizon, task == "shapematch"
        return MPCConfig(
            task=task,
            preset="quick" if name == "quick" else "paper",
            environment=replace(environment, num_envs=1),
            report=ReportConfig(horizon // 4 + 1, 1, True, checkpoint_every=horizon // 20 + 1, log_every=10),
            grid=16 if silhouette else "coarse",
            planner=PlannerConfig(iterations=30, learning_rate=0.1) if silhouette else PlannerConfig(),
        )

    @property
    def policy(self) -> OpenLoop:
        """The record so far."""
        return OpenLoop(self.actions)

    def learn(self, total_timesteps: int, callback: Callback) -> MPC:
        """Carry out some more steps, fewer if the episode ends."""
        end = self.num_timesteps + total_timesteps
        while self.num_timesteps < end and not self.over:
            action = self.planner.act()
            self._carry_out(action)
            self.actions = torch.cat((self.actions, action.float().cpu()))
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
