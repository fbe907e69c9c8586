"""Episodes of simulations that are learned from: when they end, and on which layout the next one starts."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cfp.analytic.stateful import Stateful
from cfp.envs.vec_env import TorchVecEnv, first_limits
from dittogym import TorchEnv


class Episodes(Stateful):
    """Ends the episodes of an environment and starts new ones.

    Episodes are truncated after ``max_episode_steps``; the first one of element i of the batch already after a fraction
    ``(i + 1) / B`` of them, so that the simulations are of different ages. A simulation that is not finite ends like
    any other, and is counted.
    """

    values = ("limit", "returns", "num_started", "counts", "recent_returns")

    def __init__(self, env: TorchEnv, seed: int, max_episode_steps: int, num_layouts: int) -> None:
        self.env, self.num_layouts = env, num_layouts
        count = env.num_envs
        self.first_seed = seed + count
        env.reset(seed=[self.first_seed + i % num_layouts for i in range(count)])
        self.max_steps = min(max_episode_steps, env.spec.horizon)
        self.limit = first_limits(count, self.max_steps, env.device)
        self.returns = torch.zeros(count, device=env.device)
        self.recent_returns: list[float] = []  # undiscounted; of the episodes since the list was last emptied
        self.num_started = count
        self.counts = {"episodes": 0, "terminated": 0, "nonfinite": 0}

    def record(self, reward: Tensor, terminated: Tensor) -> Tensor:
        """Add the rewards (B,) of a step to the returns; tell which episodes are over, (B,) bool."""
        self.returns = self.returns + reward  # not in place: a saved state may hold it
        return terminated | (self.env.env_state.steps >= self.limit)

    def restart(self, done: Tensor, terminated: Tensor, finite: Tensor) -> None:
        """Start new episodes where ``done`` (B,), each on the next layout; count how they ended."""
        seeds = [0] * self.env.num_envs
        for i in done.nonzero()[:, 0].tolist():
            self.counts["episodes"] += 1
            self.counts["terminated"] += int(terminated[i])
            self.counts["nonfinite"] += int(~finite[i])
            self.recent_returns.append(float(self.returns[i]))
            seeds[i] = self.first_seed + self.num_started % self.num_layouts
            self.num_started += 1
        if bool(done.any()):
            self.env.reset(seed=seeds, options={"reset_mask": done})
        self.returns = torch.where(done, 0.0, self.returns)
        self.limit = torch.where(done, self.max_steps, self.limit)

    def scalars(self) -> dict[str, float | None]:
        """Counts, and the mean of `recent_returns`."""
        scalars: dict[str, float | None] = {f"train/{name}": float(count) for name, count in self.counts.items()}
        return scalars | {"rollout/return": float(np.mean(self.recent_returns)) if self.recent_returns else None}

    def state_dict(self) -> dict[str, Any]:
        """The episodes in progress, and what the next ones depend on."""
        return super().state_dict() | {"env": TorchVecEnv(self.env).state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        super().load_state_dict(state)
        TorchVecEnv(self.env).load_state_dict(state["env"])
