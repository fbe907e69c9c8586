"""Differentiable rollouts of a task: states, actions and rewards as functions, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from dittogym import core as dynamics
from dittogym.action import ActionIndexing, to_grid_indexing
from dittogym.core import EnvState, Model
from dittogym.observation.smooth import soft_observation
from torchmpm import trajectory, tree


class Judgement(NamedTuple):
    """What a control step was worth.

    Attributes:
        state: After the step, with the task's memory brought up to date.
        reward: (B,) to differentiate.
        true_reward: (B,) the task's own.
        ended: (B,) bool, whether the episode ends.
    """

    state: EnvState
    reward: Tensor
    true_reward: Tensor
    ended: Tensor


#: From the task, the state after a transition and the actuation on the patch.
Judge: TypeAlias = Callable[[Model, EnvState, Tensor], Judgement]


def judge(model: Model, state: EnvState, field: Tensor) -> Judgement:
    """The task's smooth reward beside its true one, see :meth:`dittogym.TorchEnv.step` with ``soft``."""
    judged, outcome = dynamics.judge(model, state, field, dynamics.observe(model, state))
    soft = dynamics.judge(model, state, field, soft_observation(model, state), soft=True)[1]
    assert outcome.terminated is not None
    return Judgement(judged, _sum(soft.terms), _sum(outcome.terms).detach(), outcome.terminated)


def judge_true(model: Model, state: EnvState, field: Tensor) -> Judgement:
    """The task's true reward alone, for searches without gradients."""
    judged, outcome = dynamics.judge(model, state, field, dynamics.observe(model, state))
    assert outcome.terminated is not None
    total = _sum(outcome.terms)
    return Judgement(judged, total, total, outcome.terminated)


def _sum(terms: Mapping[str, Tensor]) -> Tensor:
    return torch.stack(tuple(terms.values())).sum(0)


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
    judge: Judge = judge,
    *,
    layout: ActionIndexing = "image",
    checkpointed: bool = True,
) -> Rollout:
    """Drive simulations through some control steps.

    Args:
        model: The task, such as ``TorchEnv.model``.
        start: Where the simulations start, B of them.
        actions: (T, B, 2, R, R), as :meth:`dittogym.TorchEnv.step` takes them.
        judge: What a step is worth.
        layout: Of the actions.
        checkpointed: Keep only the states between the steps and replay each step in the backward pass.
    """

    def step(before: Judgement, action: Tensor) -> Judgement:
        state, field = dynamics.transition(model, before.state, to_grid_indexing(action, layout))
        after, over = judge(model, state, field), before.ended
        earned, true = (torch.where(over, 0.0, reward) for reward in (after.reward, after.true_reward))
        return Judgement(after.state, earned, true, over | after.ended)

    nothing = actions.new_zeros(actions.shape[1])
    last, steps = trajectory(
        step,
        Judgement(start, nothing, nothing, nothing.bool()),
        actions,
        observe=lambda judgement: (judgement.reward, judgement.true_reward),
        checkpointed=checkpointed,
    )
    rewards, true_rewards = (torch.stack(values) for values in zip(*steps, strict=True))
    return Rollout(last.state, rewards, true_rewards, last.ended)


def repeat(state: EnvState, copies: int) -> EnvState:
    """The first simulation of a state, ``copies`` times."""
    return tree.map(lambda t: t[:1].expand(copies, *t.shape[1:]), state)


def to_dtype(state: EnvState, dtype: torch.dtype) -> EnvState:
    """The same state in another floating point type."""
    return tree.map(lambda t: t.to(dtype) if t.is_floating_point() else t, state)
