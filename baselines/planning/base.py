"""Receding-horizon planning in the simulator: what planners share, however they search."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
from torch import Tensor

from baselines.common.rollout import StepFunction, check_differentiable, rollout, soft_step
from cfp.analytic.window import split_cost
from cfp.errors import ConfigError, check_at_least
from cfp.resumable import Resumable
from dittogym import TorchEnv
from dittogym.core import EnvState, Model, StepResult
from dittogym.rewards import features_of
from torchmpm import tree

#: Fraction of the task's limit on the robot's spread from which a spread costs.
SPLIT_MARGIN = 0.8


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """Options that all planners have."""

    horizon: int = 16
    """Control steps that a plan looks ahead."""
    commit: int = 8
    """Control steps of a plan that are carried out before the next plan is made."""
    noise: float = 0.1
    """Standard deviation of the random actions that extend a plan."""
    termination_steps: float = 32.0
    """Control steps for which a plan that ends the episode early is charged its mean reward, if that is positive."""
    split_weight: float = 1000.0
    """Weight of the cost of a large spread: the square of the amount by which spread / limit exceeds 0.8."""

    def check_planner(self, resolution: int) -> None:
        """Check what the types do not express, for plans on an action grid of ``resolution`` rows and columns.

        Raises:
            ConfigError: An option is out of range.
        """
        check_at_least(1, horizon=self.horizon)
        if not 1 <= self.commit <= self.horizon:
            raise ConfigError(f"commit must be between 1 and the horizon, {self.horizon}, got {self.commit}")
        check_at_least(0, noise=self.noise, termination_steps=self.termination_steps, split_weight=self.split_weight)


Config = TypeVar("Config", bound=PlannerConfig)


class Planner(Resumable, ABC, Generic[Config]):
    """Base class of planners, which plan the next actions of each simulation of an environment by itself.

    Plans are tried in the simulator that the environment itself runs on, from its present state, so that a planner sees
    everything except the conditions that disturb actions. The part of a plan that was not carried out is kept and
    extended by noise. Of all plans that a search evaluates, the one with the highest true return is carried out.

    Args:
        env: The environment, after its reset. It is only read: call ``env.step(planner.act())``.
        config: Options, a `baselines.GradientPlannerConfig` or a `baselines.CEMPlannerConfig`; None for the defaults.
        step: What advances the simulations, a `baselines.common.rollout.StepFunction`; None for the task's own step. A
            search by gradients climbs its reward; its true reward chooses the plan.
        seed: Seed of the noise.

    Attributes:
        num_plans: Number of plans evaluated so far.
        num_failed: Number of plans so far whose return or gradient was not finite; they are never carried out.

    Raises:
        cfp.ConfigError: An option is out of range, or a search by gradients is to plan in a task whose reward has none.
        RuntimeError: The environment was not reset yet, for a search by gradients.
    """

    config_type: type[Config]
    default_step: StepFunction = staticmethod(soft_step)
    values = ("_plan", "_step", "num_failed", "num_plans", "generator")

    def __init__(
        self, env: TorchEnv, config: Config | None = None, *, step: StepFunction | None = None, seed: int = 0
    ) -> None:
        self.config = config = config or self.config_type()
        config.check_planner(env.action_resolution)
        self.env, self.step = env, step or self.default_step
        if self.step is soft_step:
            check_differentiable(env)
        self.generator = torch.Generator().manual_seed(seed)
        self.num_plans = self.num_failed = 0
        self.reset()

    def reset(self) -> None:
        """Drop the present plan, for a new episode."""
        self._plan, self._step = self._random_actions(self.config.horizon), self.config.commit

    @property
    def needs_plan(self) -> bool:
        """Whether the next call of `act` makes new plans."""
        return self._step >= min(self.config.commit, len(self._plan))

    def act(self) -> Tensor:
        """Return the next action of every simulation, after making new plans if the last ones are used up.

        Returns:
            (B, 2, R, R) in [-1, 1], for `dittogym.TorchEnv.step`.

        Raises:
            RuntimeError: The environment was not reset yet.
        """
        if self.needs_plan:
            self.plan()
        self._step += 1
        return self._plan[self._step - 1]

    def plan(self) -> Tensor:
        """Make new plans from the environment's present state.

        Returns:
            (T, B, 2, R, R) in [-1, 1], where T is the horizon of the options or, if it is smaller, the number of steps
            to the end of the youngest episode.

        Raises:
            RuntimeError: The environment was not reset yet.
        """
        state = tree.detach(self.env.env_state)
        remaining = self._remaining_steps(state)
        length = min(self.config.horizon, remaining) if remaining else self.config.horizon
        kept = self._plan[self._step :][:length]
        plan = torch.cat((kept, self._random_actions(length - len(kept))))
        self._plan, self._step = self._search(state, plan).detach(), 0
        return self._plan

    @abstractmethod
    def _search(self, state: EnvState, plan: Tensor) -> Tensor:
        """Find the best plan (T, B, 2, R, R) from a state, starting from ``plan`` of the same shape."""

    def _evaluate(self, state: EnvState, plan: Tensor) -> tuple[Tensor, Tensor]:
        """Smooth returns, and true returns less the charge for early ends, of plans (T, B, 2, R, R): (B,) each."""
        smooth, value = self._returns(state, plan)
        self.num_plans += len(value)
        self.num_failed += int((~value.isfinite()).sum())
        return smooth, value

    def _returns(self, state: EnvState, plan: Tensor) -> tuple[Tensor, Tensor]:
        layout = self.env.action_layout
        steps = rollout(self.env.model, state, plan, self._penalised, action_layout=layout, checkpointed=False)
        total = steps.true_rewards.sum(0)
        charged = min(self.config.termination_steps, max(self._remaining_steps(state) - len(plan), 0))
        charge = torch.where(steps.ended, charged / len(plan) * total.clamp_min(0.0), 0.0)
        return steps.rewards.sum(0), total - charge

    def _penalised(self, model: Model, state: EnvState, action: Tensor) -> StepResult:
        """Rewards of a step less a cost of being nearly torn: the task's own penalty comes when it is too late."""
        result, limit = self.step(model, state, action), model.spec.split_limit
        if limit is None:
            return result
        split = features_of(result.state.particles, model.num_robot_particles).radius_of_gyration
        cost = split_cost(split, limit, SPLIT_MARGIN, self.config.split_weight)
        reward, true_reward = result.reward - cost, result.true_reward - cost.detach()
        return result._replace(reward=reward, true_reward=true_reward)

    def _remaining_steps(self, state: EnvState) -> int:
        """Control steps to the end of the youngest episode."""
        return max(self.env.spec.horizon - int(state.steps.min()), 0)

    def _random_actions(self, steps: int) -> Tensor:
        shape = (steps, self.env.num_envs, *self.env.action_shape)
        noise = torch.randn(shape, generator=self.generator, dtype=self.env.dtype).to(self.env.device)
        return (self.config.noise * noise).clamp(-1.0, 1.0)


class BestPlans:
    """The plan with the highest finite value so far, of every simulation; zero where no value was finite."""

    def __init__(self, like: Tensor) -> None:
        self.plan = torch.zeros_like(like)  # (T, B, 2, R, R)
        self.value = like.new_full((like.shape[1],), -torch.inf)  # (B,)

    def update(self, plan: Tensor, value: Tensor) -> None:
        """Take over plans (T, B, 2, R, R) whose values (B,) are finite and better."""
        better = value.isfinite() & (value > self.value)
        self.value = torch.where(better, value, self.value)
        self.plan = where_simulation(better, plan.detach(), self.plan)


def where_simulation(mask: Tensor, yes: Tensor | float, no: Tensor) -> Tensor:
    """Choose plans (T, B, 2, R, R) by a mask (B,) over the simulations."""
    return torch.where(mask[:, None, None, None], yes, no)
