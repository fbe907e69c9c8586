"""Differentiable rollouts of a task: states, actions and rewards as functions, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from cfp.analytic.window import has_gradient
from cfp.errors import ConfigError
from dittogym import TorchEnv, core
from dittogym.action import ActionLayout, to_grid_layout
from dittogym.core import EnvState, Model, StepResult
from torchmpm import trajectory

#: From the task, a state and actions (B, 2, R, R) in the layout ``"grid"``, such as :func:`dittogym.core.step`.
StepFunction: TypeAlias = Callable[[Model, EnvState, Tensor], StepResult]


def soft_step(model: Model, state: EnvState, action: Tensor) -> StepResult:
    """A step with the task's smooth reward."""
    return core.step(model, state, action, soft=True)


def check_differentiable(env: TorchEnv) -> None:
    """Raise a `ConfigError` if the reward of the environment's task has no gradient in the actions."""
    if not has_gradient(env):
        raise ConfigError(f"task: the reward of {env.spec.name!r} has no gradient in the actions")


class Rollout(NamedTuple):
    """Some control steps of B simulations. After its end a simulation earns nothing more, as in an episode.

    Attributes:
        state: After the last step.
        rewards: (T, B) to differentiate.
        true_rewards: (T, B) the task's own.
        ended: (B,) bool, whether the episode has ended.
    """

    state: EnvState
    rewards: Tensor
    true_rewards: Tensor
    ended: Tensor


def rollout(
    model: Model,
    start: EnvState,
    actions: Tensor,
    step: StepFunction = soft_step,
    *,
    action_layout: ActionLayout = "image",
    checkpointed: bool = True,
) -> Rollout:
    """Drive simulations through some control steps.

    Args:
        model: The task, such as ``TorchEnv.model``.
        start: Where the simulations start, B of them.
        actions: (T, B, 2, R, R), as :meth:`dittogym.TorchEnv.step` takes them.
        step: Advances the simulations; by default the reward is the smooth one.
        action_layout: Of the actions, see :class:`dittogym.TorchEnv`.
        checkpointed: Keep only the states between the steps and replay each step in the backward pass.
    """

    def advance(before: _Step, action: Tensor) -> _Step:
        result = step(model, before.state, to_grid_layout(action, action_layout))
        reward, true_reward = (
            torch.where(before.ended, 0.0, value) for value in (result.reward, result.true_reward.detach())
        )
        return _Step(result.state, reward, true_reward, before.ended | result.terminated)

    zero = actions.new_zeros(actions.shape[1])
    last, rewards = trajectory(
        advance,
        _Step(start, zero, zero, zero.bool()),
        actions,
        observe=lambda after: (after.reward, after.true_reward),
        checkpointed=checkpointed,
    )
    smooth, true = (torch.stack(values) for values in zip(*rewards, strict=True))
    return Rollout(last.state, smooth, true, last.ended)


class _Step(NamedTuple):
    """State, rewards (B,) of the last step, and whether the episode has ended, (B,)."""

    state: EnvState
    reward: Tensor
    true_reward: Tensor
    ended: Tensor
