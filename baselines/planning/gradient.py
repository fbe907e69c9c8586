"""Receding-horizon planning with the simulator: what all planners share, and the one that climbs gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from baselines.common.rollout import StepFunction, rollout, soft_step
from cfp.config import not_negative, positive
from cfp.errors import ConfigError
from dittogym import TorchEnv
from dittogym.contract import measure
from dittogym.core import StepResult
from dittogym.model import EnvState, Model
from torchmpm import tree

SAFE_SPREAD = 0.8
"""Share of the limit of its spread up to which a robot is not in danger of being torn."""


@dataclass(frozen=True)
class PlanConfig:
    """What a plan is, however it is found."""

    horizon: int = 16
    """Control steps that a plan looks ahead."""
    commit: int = 8
    """Control steps of a plan that are carried out before the next is made."""
    noise: float = 0.1
    """Standard deviation of the actions with which a plan is extended."""
    forgone: float = 32.0
    """Control steps at its mean reward that a plan is charged for ending the episode before its time."""
    margin: float = 1000.0
    """Cost of a spread beyond 80 % of the limit at which the robot counts as torn, per squared share of the limit."""

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        if not 1 <= self.commit <= self.horizon:
            raise ConfigError(f"commit: got {self.commit}, allowed 1 to the horizon, {self.horizon}")
        not_negative(noise=self.noise, forgone=self.forgone, margin=self.margin)


@dataclass(frozen=True)
class PlannerConfig(PlanConfig):
    """How a plan is made by gradients."""

    iterations: int = 6
    """Gradient steps on a plan."""
    learning_rate: float = 0.6
    """Adam's step size on actions, which lie in [-1, 1]."""
    clip: float = 3.0
    """Largest gradient of one control step, in medians over the steps of the plan."""

    def check(self) -> None:
        """Check what the types cannot, see `PlanConfig.check`."""
        super().check()
        positive(iterations=self.iterations, learning_rate=self.learning_rate, clip=self.clip)


Config = TypeVar("Config", bound=PlanConfig)


class PlannerBase(ABC, Generic[Config]):
    """Plans for all simulations of an environment, each for itself.

    The plan of a simulation is what it would do from its present state on; it is tried in the same simulator that the
    environment is, so the planner sees everything: state, matter, obstacles. Between plans, the part that was not
    carried out is kept and extended by noise. Of all plans met in a search, the one with the highest true return is
    carried out; a plan that ends the episode forgoes what would come after it.

    Args:
        env: The environment; only read, after its reset.
        config: How to plan.
        judge: What a step is worth; the true reward chooses.
        seed: Of the noise.

    Attributes:
        failed: Plans that were not finite so far; they are never carried out.
        plans: Plans evaluated so far.

    Raises:
        ConfigError: An option is out of range.
    """

    options: type[Config]

    def __init__(
        self,
        env: TorchEnv,
        config: Config | None = None,
        *,
        judge: StepFunction = soft_step,
        seed: int = 0,
    ) -> None:
        self.config = config = config or self.options()
        config.check()
        self.env, self.judge = env, judge
        self.generator = torch.Generator().manual_seed(seed)
        self.failed = self.plans = 0
        self._ahead = self._fresh(config.horizon)
        self._position = config.commit

    def _fresh(self, steps: int) -> Tensor:
        shape = (steps, self.env.num_envs, *self.env.action_shape)
        noise = torch.randn(shape, generator=self.generator, dtype=self.env.dtype).to(self.env.device)
        return (self.config.noise * noise).clamp(-1.0, 1.0)

    def act(self) -> Tensor:
        """Next action of every simulation, (B, 2, R, R); plans anew where the last plan is used up."""
        if self.due:
            self.plan()
        self._position += 1
        return self._ahead[self._position - 1]

    @property
    def due(self) -> bool:
        """Whether the last plan is used up, so that the next action needs another."""
        return self._position >= min(self.config.commit, len(self._ahead))

    @property
    def fresh(self) -> bool:
        """Whether the last action was the first of its plan."""
        return self._position == 1

    def forget(self) -> None:
        """Drop the present plan, for a new episode."""
        self._ahead, self._position = self._fresh(self.config.horizon), self.config.commit

    def state_dict(self) -> dict[str, Any]:
        """All that the next action depends on beside the environment."""
        return {
            "ahead": self._ahead.cpu(),
            "counts": [self._position, self.failed, self.plans],
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict` in a planner made with the same options."""
        self._ahead = state["ahead"].to(self._ahead)
        self._position, self.failed, self.plans = state["counts"]
        self.generator.set_state(state["generator"])

    def plan(self) -> Tensor:
        """Make new plans from the environment's present state: actions (T, B, 2, R, R)."""
        config, start = self.config, tree.detach(self.env.env_state)
        left = self._left(start)
        length = min(config.horizon, left) if left else config.horizon
        kept = self._ahead[self._position :][:length]
        plan = torch.cat((kept, self._fresh(length - len(kept))))
        self._ahead, self._position = self._search(start, plan).detach(), 0
        return self._ahead

    @abstractmethod
    def _search(self, start: EnvState, plan: Tensor) -> Tensor:
        """The best plan (T, B, 2, R, R) that is found from what is kept of the last; counts all it tries."""

    def _left(self, start: EnvState) -> int:
        """Control steps to the end of the youngest episode."""
        return max(self.env.spec.horizon - int(start.steps.min()), 0)

    def _careful(self, model: Model, state: EnvState, action: Tensor) -> StepResult:
        """What a step is worth, less the cost of being nearly torn: the true penalty comes when it is too late."""
        result, limit = self.judge(model, state, action), model.spec.split_limit
        if limit is None:
            return result
        excess = measure(result.state.particles, model.num_robot_particles).split / limit - SAFE_SPREAD
        cost = self.config.margin * excess.clamp_min(0.0).square()
        reward, true_reward = result.reward - cost, result.true_reward - cost.detach()
        return result._replace(reward=reward, true_reward=true_reward)

    def _judge(self, start: EnvState, plan: Tensor) -> tuple[Tensor, Tensor]:
        """Smooth return, and true return less what ending forgoes, of plans (T, B, 2, R, R): (B,) each."""
        layout = self.env.action_layout
        steps = rollout(self.env.model, start, plan, self._careful, layout=layout, checkpointed=False)
        total = steps.true_rewards.sum(0)
        after = min(self.config.forgone, max(self._left(start) - len(plan), 0))
        charge = torch.where(steps.ended, after / len(plan) * total.clamp_min(0.0), 0.0)
        return steps.rewards.sum(0), total - charge


class Planner(PlannerBase[PlannerConfig]):
    """Plans by Adam on the next actions, see `PlannerBase`: the gradient goes through the simulator.

    The judge's smooth reward is climbed.
    """

    options = PlannerConfig

    def _search(self, start: EnvState, plan: Tensor) -> Tensor:
        config, plan = self.config, plan.requires_grad_()
        adam = torch.optim.Adam([plan], config.learning_rate, (0.9, 0.95))
        best, chosen = torch.full_like(plan[0, :, 0, 0, 0], -torch.inf), torch.zeros_like(plan)
        for iteration in range(config.iterations + 1):
            learns = iteration < config.iterations
            with torch.set_grad_enabled(learns):
                climbed, value = self._judge(start, plan)
            self.plans += len(value)
            better = value.isfinite() & (value > best)
            best = torch.where(better, value, best)
            chosen = torch.where(_spread(better), plan.detach(), chosen)
            if not learns:
                self.failed += int((~value.isfinite()).sum())
                break
            (gradient,) = torch.autograd.grad(climbed, plan, -torch.ones_like(climbed))  # a caller's no_grad holds here
            broken = ~(value.isfinite() & gradient.isfinite().flatten(2).all(2).all(0))
            self.failed += int(broken.sum())
            plan.grad = torch.where(_spread(broken), 0.0, _clipped(gradient, config.clip))
            adam.step()
            with torch.no_grad():
                plan.copy_(torch.where(_spread(broken), chosen, plan.clamp(-1.0, 1.0)))
        return chosen


def _spread(mask: Tensor) -> Tensor:
    """A mask over simulations (B,) as one over plans (T, B, 2, R, R)."""
    return mask[:, None, None, None]


def _clipped(gradient: Tensor, limit: float) -> Tensor:
    """Limit the norm of each control step of a gradient (T, B, 2, R, R) to ``limit`` medians over the steps.

    Steps after the end of an episode have no gradient and do not count.
    """
    norm = gradient.flatten(2).norm(dim=2)
    middle = (norm > 0).sum(0) // 2
    largest = limit * norm.sort(0, descending=True).values.gather(0, middle[None])
    scale = torch.where(norm > largest, largest / norm, 1.0)
    return gradient * scale[:, :, None, None, None]
