"""Model predictive control: planners as algorithms that plan their way through one episode and record it."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from baselines.common.grid import Grid, OptimisationConfig, long_dt
from baselines.common.open_loop import OpenLoop, OpenLoopLearner
from baselines.planning.base import Planner, PlannerConfig
from baselines.planning.cem import CEMPlanner, CEMPlannerConfig
from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import reward_error
from cfp.errors import ConfigError
from cfp.learner import Scalars, Sees
from cfp.presets import sac_preset
from dittogym import TorchEnv, make_spec
from dittogym.core import EnvState
from dittogym.physics import PER_PARTICLE
from torchmpm import tree

#: Nearest particles among which each particle looks for one that is not taken yet.
NEIGHBOURS = 16

#: Every scalar that ``MPC.update`` logs, and what it means.
METRICS: dict[str, str] = {
    "train/return": "sum of the rewards of the episode so far",
    "train/reward": "reward of the last step",
    "train/plans": "plans evaluated so far; each is a simulation of the planner's horizon",
    "train/failed": "plans so far that were not finite; they are never carried out",
}


@dataclass(frozen=True, kw_only=True)
class PlannedConfig(PlannerConfig, OptimisationConfig):
    """Options of an episode that is planned, with one robot on the layout of the seed.

    The environment options apply to the episode that is carried out, train_particles and train_dt to the simulations in
    which plans are tried.
    """

    def ends(self) -> tuple[int, ...]:
        """Environment steps after which the only stage ends, at the latest."""
        return (make_spec(self.task).horizon,)

    def evaluation(self, stage: int) -> tuple[int, int]:
        """The episode is evaluated on the layout that it was planned on."""
        return self.seed, 1

    def check(self) -> None:
        """Check what the types do not express."""
        super().check()
        self.check_planner(self.resolution(1))
        if self.num_envs != 1:
            raise ConfigError(f"num_envs must be 1 (an episode is planned by itself), got {self.num_envs}")


@dataclass(frozen=True, kw_only=True)
class MPCConfig(GradientPlannerConfig, PlannedConfig):
    """Options of an episode that is planned by gradients."""

    algo: str = "mpc"
    """Name of the algorithm."""


@dataclass(frozen=True, kw_only=True)
class CEMConfig(CEMPlannerConfig, PlannedConfig):
    """Options of an episode that is planned by the cross-entropy method."""

    algo: str = "cem"
    """Name of the algorithm."""


def planner_preset(task: str) -> tuple[GradientPlannerConfig, Grid]:
    """Planner and action grid for a task; SHAPE MATCH, whose reward is all detail, gets finer actions and steps."""
    if task == "shapematch":
        return GradientPlannerConfig(iterations=30, learning_rate=0.1), 16
    return GradientPlannerConfig(), "coarse"


def episode_preset(task: str, name: str) -> dict[str, Any]:
    """Options of `PlannedConfig` for a task."""
    base, horizon = sac_preset(task, name), make_spec(task).horizon
    return {
        **vars(base.environment),
        "num_envs": 1,
        "task": task,
        "preset": name,
        "eval_every": horizon // 4 + 1,
        "eval_episodes": 1,
        "eval_deterministic": True,
        "checkpoint_every": horizon // 20 + 1,
        "log_every": 10,
        "grid": planner_preset(task)[1],
        "train_particles": None if name == "quick" else "lite",
        "train_dt": long_dt(task),
    }


class Surrogate:
    """Copies the states of one environment into another of the same task, with as many particles or fewer.

    Each particle of the small environment stands for the nearest of the large in the initial positions of both, and
    takes over its position, velocity and deformation; masses and volumes are the small environment's own.
    """

    def __init__(self, large: TorchEnv, small: TorchEnv) -> None:
        self.env = small
        self.indices = _nearest_particles(large, small)  # (B, n) of the large environment's particles
        same = large.model.counts == small.model.counts
        own = {} if same else small.env_state.task_state
        # Numbers of particles, such as those of the tip in GROW, see `dittogym.Reward`.
        self._particle_state = {
            name: value for name, value in own.items() if value.dtype == torch.int64 and value.ndim == 2
        }

    def sync(self, state: EnvState) -> None:
        """Bring the small environment to a state of the large one."""

        def select(value: Tensor) -> Tensor:
            return value[torch.arange(len(value), device=value.device)[:, None], self.indices]

        physics = {
            name: select(value) if name in PER_PARTICLE and value.ndim == 2 else value
            for name, value in state.physics.items()
        }
        task_state = {**state.task_state, **self._particle_state}
        self.env.env_state = replace(
            state, particles=tree.map(select, state.particles), physics=physics, task_state=task_state
        )


def _nearest_particles(large: TorchEnv, small: TorchEnv) -> Tensor:
    """Indices (B, n) of the large environment's nearest particles, body by body, each at most once."""
    if torch.equal(large.state.x, small.state.x):
        return torch.arange(large.num_particles, device=large.device).expand(large.num_envs, -1)
    indices, start, small_start = [], 0, 0
    for many, few in zip(large.model.solver.bodies, small.model.solver.bodies, strict=True):
        if few.count > many.count:
            raise ConfigError(f"train_particles of a body must be at most {many.count}, got {few.count}")
        x = large.state.x[:, start : start + many.count].detach()
        small_x = small.state.x[:, small_start : small_start + few.count].detach()
        nearest = torch.cdist(small_x, x).topk(min(NEIGHBOURS, many.count), largest=False).indices
        indices.append(torch.stack([_assign(rows, many.count) for rows in nearest.cpu()]) + start)
        start, small_start = start + many.count, small_start + few.count
    return torch.cat(indices, 1).to(large.device)


def _assign(nearest: Tensor, count: int) -> Tensor:
    """The first index of each row (n, k) that no earlier row has, or any free one where all are taken."""
    free, assigned = set(range(count)), []
    for row in nearest.tolist():
        index = next((index for index in row if index in free), None)
        assigned.append(min(free) if index is None else index)
        free.remove(assigned[-1])
    return torch.tensor(assigned)


class MPC(OpenLoopLearner):
    """Model predictive control by gradients, see `baselines.GradientPlanner`.

    There is nothing to learn: an update carries out a planned step of a single episode, and the policy is the record of
    its actions, a `baselines.OpenLoop`. On the layout of its seed the record repeats the episode; other layouts have to
    be planned for themselves.

    Args:
        config: Options, such as those of ``MPC.preset(task, "quick")``.

    Raises:
        cfp.ConfigError: An option is out of range, or the reward of the task has no gradient in the actions.
    """

    sees: ClassVar[Sees] = "simulator"
    keeps_best: ClassVar[bool] = False  # an earlier policy is only the beginning of the episode
    planner_type: ClassVar[type[Planner[Any]]] = GradientPlanner

    def __init__(self, config: PlannedConfig) -> None:
        self.config = config
        self.env = make_torch_env(config, config.resolution(1), 1)
        self.env.reset(seed=config.seed)
        self.surrogate = None
        if config.for_training() != config:
            cheap = make_torch_env(config.for_training(), config.resolution(1), 1)
            cheap.reset(seed=config.seed)
            self.surrogate = Surrogate(self.env, cheap)
        planning_env = self.surrogate.env if self.surrogate else self.env
        self.planner = self.planner_type(planning_env, config, seed=config.seed)
        self.actions = torch.zeros(0, *self.env.action_shape)
        self.total_reward, self.reward = 0.0, 0.0

    @classmethod
    def create(cls, config: PlannedConfig, stage: int, folder: Path) -> "MPC":
        """The planner at the beginning of the episode."""
        return cls(config)

    @staticmethod
    def preset(task: str, name: str) -> PlannedConfig:
        """Defaults of a task."""
        return MPCConfig(**(episode_preset(task, name) | vars(planner_preset(task)[0])))

    @property
    def trained_policy(self) -> OpenLoop:
        """The record so far, with its layout."""
        return OpenLoop(self.actions, {"layout": self.config.seed})

    def update(self) -> Scalars:
        """Carry out one more step; a `NonFiniteError` if its reward is not finite."""
        if self.surrogate and self.planner.needs_plan:
            self.surrogate.sync(self.env.env_state)
        action = self.planner.act().float()  # as the record keeps it, so that it repeats the episode exactly
        self._carry_out(action)
        self.actions = torch.cat((self.actions, action.cpu()))
        self.num_timesteps += 1
        return {
            "train/return": self.total_reward,
            "train/reward": self.reward,
            "train/plans": float(self.planner.num_plans),
            "train/failed": float(self.planner.num_failed),
        }

    @torch.no_grad()
    def _carry_out(self, action: Tensor) -> None:
        _, reward, terminated, _, info = self.env.step(action)
        self.reward = float(reward)
        if not math.isfinite(self.reward):
            raise reward_error(info["reward_terms"])
        self.total_reward += self.reward
        self.finished = bool(terminated)

    def state_dict(self) -> dict[str, Any]:
        """Actions and planner; the state of the robot is restored by repeating its actions."""
        return {"actions": self.actions, "planner": self.planner.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self.actions = state["actions"]
        for action in self.actions.to(self.env.device):
            self._carry_out(action[None])
        self.planner.load_state_dict(state["planner"])


class CEM(MPC):
    """Model predictive control by the cross-entropy method, see `baselines.CEMPlanner`; else as `baselines.MPC`.

    Args:
        config: Options, such as those of ``CEM.preset(task, "quick")``.

    Raises:
        cfp.ConfigError: An option is out of range.
    """

    planner_type: ClassVar[type[Planner[Any]]] = CEMPlanner

    @staticmethod
    def preset(task: str, name: str) -> CEMConfig:
        """Defaults of a task."""
        return CEMConfig(**episode_preset(task, name))
