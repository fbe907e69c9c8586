"""Episodes of a batch of simulations that are learned from: when they end, and on which layout the next begins."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cfp.envs.vec_env import TorchVecEnv
from dittogym import TorchEnv


class Episodes:
    """What happens to the episodes of an environment.

    Element i of the batch is first cut at ``age * (i + 1) / B`` steps, later at ``age``; so not all are young at once.
    A simulation that is not finite ends like any other, and is counted.

    Args:
        env: The simulations; they are reset.
        seed: Of the layouts.
        age: Control steps after which an episode is cut; at most the task's own.
        layouts: Particle layouts that are gone through.

    Attributes:
        ended: Undiscounted returns of the episodes that ended since the list was last emptied.
        counts: Episodes so far, and how they ended.
    """

    def __init__(self, env: TorchEnv, seed: int, age: int, layouts: int) -> None:
        self.env, self.layouts = env, layouts
        count = env.num_envs
        self.first_layout = seed + count
        env.reset(seed=[self.first_layout + i % layouts for i in range(count)])
        self.age = min(age, env.spec.horizon)
        self.limit = torch.tensor([max(1, self.age * (i + 1) // count) for i in range(count)], device=env.device)
        self.returns = torch.zeros(count, device=env.device)
        self.ended: list[float] = []
        self.drawn = count
        self.counts = {"episodes": 0, "terminated": 0, "nonfinite": 0}

    def over(self, terminated: Tensor) -> Tensor:
        """Which simulations are at the end of their episode, (B,) bool."""
        return terminated | (self.env.env_state.steps >= self.limit)

    def restart(self, out: Tensor, terminated: Tensor, finite: Tensor) -> None:
        """Begin new episodes where ``out`` (B,) says so, each on the next layout."""
        seeds = [0] * self.env.num_envs
        for i in out.nonzero()[:, 0].tolist():
            self.counts["episodes"] += 1
            self.counts["terminated"] += int(terminated[i])
            self.counts["nonfinite"] += int(~finite[i])
            self.ended.append(float(self.returns[i]))
            seeds[i] = self.first_layout + self.drawn % self.layouts
            self.drawn += 1
        if bool(out.any()):
            self.env.reset(seed=seeds, options={"reset_mask": out})
        self.returns = torch.where(out, 0.0, self.returns)
        self.limit = torch.where(out, self.age, self.limit)

    def scalars(self) -> dict[str, float | None]:
        """Counts, and the mean true return of the episodes that ended since the list was last emptied."""
        scalars: dict[str, float | None] = {f"train/{name}": float(count) for name, count in self.counts.items()}
        return scalars | {"rollout/return": float(np.mean(self.ended)) if self.ended else None}

    def state_dict(self) -> dict[str, Any]:
        """The episodes in progress, and what the next ones depend on."""
        return {
            "episodes": TorchVecEnv(self.env).state_dict(),
            "limit": self.limit.cpu(),
            "returns": self.returns.cpu(),
            "drawn": self.drawn,
            "counts": dict(self.counts),
            "ended": list(self.ended),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        TorchVecEnv(self.env).load_state_dict(state["episodes"])
        self.limit, self.returns = state["limit"].to(self.limit), state["returns"].to(self.returns)
        self.drawn, self.counts = state["drawn"], dict(state["counts"])
        self.ended = list(state.get("ended", ()))  # checkpoints from before have none
