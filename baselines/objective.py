"""Smooth losses of a step, for gradients through the simulation."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from dittogym import TorchEnv
from dittogym.dynamics import EnvState

Objective = Callable[[EnvState, Tensor, float], Tensor]
"""From the state after a step, its reward (B,) and the progress of training (0 to 1) to a loss (B,)."""


def make_objective(env: TorchEnv, blur: tuple[float, ...]) -> Objective:
    """Choose what to minimise in a task: the negative reward."""
    return negative_reward


def negative_reward(state: EnvState, reward: Tensor, progress: float) -> Tensor:
    """The task's own reward, for tasks in which it is smooth enough."""
    return -reward
