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

#: A function of a model, a state and actions (B, 2, R, R) in the layout ``"grid"``, such as
#: :func:`dittogym.core.step`, which returns the result of a control step.
StepFunction: TypeAlias = Callable[[Model, EnvState, Tensor], StepResult]


def soft_step(model: Model, state: EnvState, action: Tensor) -> StepResult:
    """Advance by one control step with the task's smooth reward.

    Args:
        model: The task.
        state: The present state.
        action: (B, 2, R, R) in the layout ``"grid"``.
    """
    return core.step(model, state, action, soft=True)


def check_differentiable(env: TorchEnv) -> None:
    """Raise a `ConfigError` if the reward of the environment's task has no gradient in the actions."""
    if not has_gradient(env):
        raise ConfigError(f"task: the reward of {env.spec.name!r} has no gradient in the actions")


class Rollout(NamedTuple):
    """Some control steps of B simulations; once its episode has ended, a simulation earns nothing more.

    Attributes:
        state: The state after the last step.
        rewards: (T, B) rewards to differentiate, by default the smooth ones.
        true_rewards: (T, B) exact rewards of the task, without gradient.
        ended: (B,) bool, whether the task ended the episode.
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
    """Drive simulations through some control steps, with gradients in bounded memory.

    Args:
        model: The task, such as ``env.model``.
        start: State of B simulations at the start, such as ``env.env_state``.
        actions: (T, B, 2, R, R) in [-1, 1].
        step: What advances the simulations; by default the reward is the smooth one.
        action_layout: Layout of the actions, ``"image"`` or ``"grid"``, see :class:`dittogym.TorchEnv`.
        checkpointed: Keep only the states between the steps and replay each step in the backward pass.

    Returns:
        The last state and all rewards, differentiable in actions and start.

    Raises:
        ValueError: ``actions`` has another shape or dtype.

    Examples:
        >>> import dittogym, torch
        >>> from baselines.common.rollout import rollout
        >>> env = dittogym.TorchEnv("run", num_envs=2, particles=300, substeps=10)
        >>> observation, info = env.reset(seed=0)
        >>> actions = torch.zeros(5, 2, *env.action_shape, requires_grad=True)
        >>> rollout(env.model, env.env_state, actions).rewards.sum().backward()
        >>> actions.grad.shape
        torch.Size([5, 2, 2, 8, 8])
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
