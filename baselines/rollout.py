"""Differentiable rollouts of a task: states, actions and rewards as functions, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

from dittogym import dynamics
from dittogym.action import Layout, to_grid_layout
from dittogym.dynamics import EnvState, Model
from torchmpm import trajectory

#: (model, state after a transition, actuation on the patch) -> state, reward (B,), and whether the episode ends (B,).
Reward: TypeAlias = Callable[[Model, EnvState, Tensor], tuple[EnvState, Tensor, Tensor]]


def true_reward(model: Model, state: EnvState, field: Tensor) -> tuple[EnvState, Tensor, Tensor]:
    """The task's own reward; what it counts or thresholds has no gradient."""
    state, outcome = dynamics.judge(model, state, field, dynamics.observe(model, state))
    assert outcome.terminated is not None
    return state, torch.stack(tuple(outcome.terms.values())).sum(0), outcome.terminated


def rewards(
    model: Model,
    start: EnvState,
    actions: Tensor,
    reward: Reward = true_reward,
    *,
    layout: Layout = "image",
    checkpointed: bool = True,
) -> tuple[EnvState, Tensor, Tensor]:
    """Drive simulations through some control steps.

    Args:
        model: The task, such as ``TorchEnv.model``.
        start: Where all simulations start, B of them.
        actions: (T, B, 2, R, R), as :meth:`dittogym.TorchEnv.step` takes them.
        reward: What a step is worth.
        layout: Of the actions.
        checkpointed: Keep only the states between the steps and replay each step in the backward pass.

    Returns:
        The final state, the rewards (T, B), and which simulations have ended (B,). After its end a simulation
        earns nothing more, as in an episode.
    """
    Carry: TypeAlias = tuple[EnvState, Tensor, Tensor]

    def step(carry: Carry, action: Tensor) -> Carry:
        state, _, over = carry
        state, field = dynamics.transition(model, state, to_grid_layout(action, layout))
        state, earned, ended = reward(model, state, field)
        return state, torch.where(over, 0.0, earned), over | ended

    nothing = actions.new_zeros(actions.shape[1])
    (state, _, over), earned = trajectory(
        step, (start, nothing, nothing.bool()), actions, observe=lambda carry: carry[1], checkpointed=checkpointed
    )
    return state, torch.stack(earned), over


def repeat(state: EnvState, copies: int) -> EnvState:
    """The first simulation of a state, ``copies`` times."""
    return state.map(lambda t: t[:1].expand(copies, *t.shape[1:]))


def to_dtype(state: EnvState, dtype: torch.dtype) -> EnvState:
    """The same state in another floating point type."""
    return state.map(lambda t: t.to(dtype) if t.is_floating_point() else t)
