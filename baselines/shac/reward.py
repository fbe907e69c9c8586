"""What a policy is trained on, by gradients, in place of a task's own reward."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from cfp.validation import check_at_least, check_positive
from dittogym import TorchEnv
from torchmpm import tree

SPEED = 60.0
"""Reward for a mean speed of 1 m/s."""
NEIGHBOURS, SAMPLE = 6, 500
"""Pairs of each particle that is watched, and how many are watched at most."""
REACH = 0.03
"""Particles nearer than this, m, belong together."""
SLACK = 0.25
"""Share of `REACH` by which they may drift apart for nothing."""


@dataclass(frozen=True)
class RewardConfig:
    """What is maximised while training; judgement is always by the task's own reward."""

    form: Literal["task", "speed"] = "task"
    """task: the task's own reward, made smooth; speed: 60 per m/s to the right, less the task's cost of action."""
    split_weight: float = 1000.0
    """Cost of the square by which the robot's spread, as a share of the task's limit, exceeds split_margin."""
    split_margin: float = 0.85
    """Share of the limit on the spread from which it costs; no matter in tasks without a limit."""
    integrity_weight: float = 300.0
    """Cost of particles that were close when the window, or the episode within it, began and drift apart; see
    `Pairs`."""
    scale: float = 0.05
    """Factor of the whole, so that values are not far from one."""

    def check(self) -> None:
        """Check what the types cannot.

        Raises:
            ConfigError: Naming the option, what was given and what is allowed.
        """
        check_at_least(
            0, split_weight=self.split_weight, split_margin=self.split_margin, integrity_weight=self.integrity_weight
        )
        check_positive(scale=self.scale)


@dataclass(frozen=True)
class Pairs:
    """Particles of the robot that were close to each other, and how close.

    Tearing shows in them long before the spread of the whole body does.

    Attributes:
        one: (K,) watched particles.
        other: (B, K, M) the nearest of them to each.
        distance: (B, K, M), m.
        counts: (B, K, M) which are nearer than `REACH`.
    """

    one: Tensor
    other: Tensor
    distance: Tensor
    counts: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, x: Tensor) -> Pairs:
        """Choose among a robot's particles (B, N, 2)."""
        number = min(SAMPLE, x.shape[1])
        one = torch.linspace(0, x.shape[1] - 1, number, device=x.device).long()
        spots = x[:, one]
        nearest = torch.cdist(spots, spots).topk(min(NEIGHBOURS + 1, number), largest=False)
        distance, other = nearest.values[..., 1:], nearest.indices[..., 1:]  # the first is the particle itself
        return cls(one, other, distance, distance < REACH)

    def renewed(self, anew: Tensor, x: Tensor) -> Pairs:
        """The same pairs, but chosen again among the particles (B, N, 2) of the simulations of a mask (B,)."""
        fresh = Pairs.of(x)
        other, distance = tree.where(anew, fresh.other, self.other), tree.where(anew, fresh.distance, self.distance)
        return Pairs(self.one, other, distance, tree.where(anew, fresh.counts, self.counts))

    def drift(self, x: Tensor) -> Tensor:
        """Mean square of ``(d - d_0) / REACH - SLACK`` where positive, over pairs, (B,), for particles (B, N, 2)."""
        spots = x[:, self.one]
        index = self.other.flatten(1)[..., None].expand(-1, -1, 2)
        gap = spots.gather(1, index).view(*self.other.shape, 2) - spots[:, :, None]
        distance = (gap.square().sum(-1) + 1e-12).sqrt()
        excess = ((distance - self.distance) / REACH - SLACK).clamp_min(0.0) * self.counts
        return excess.square().sum((1, 2)) / self.counts.sum((1, 2)).clamp_min(1)


def training_reward(
    config: RewardConfig, env: TorchEnv, before: Tensor, reward: Tensor, info: dict[str, Any], pairs: Pairs
) -> Tensor:
    """Reward (B,) of the step that has just been made.

    Args:
        config: Which.
        env: After the step.
        before: (B, 2) the robot's centre before it, m.
        reward: (B,) the smooth reward of ``env.step(action, soft=True)``.
        info: What came with it.
        pairs: Who was close when the window, or the episode within it, began.
    """
    terms = info["reward_terms"]
    if config.form == "speed":
        seconds = env.model.substeps * env.model.solver.dt
        reward = SPEED / seconds * (info["com"] - before)[:, 0] + terms["failure"]
        if "action" in terms:
            reward = reward + terms["action"]
    limit = env.spec.split_limit
    if limit is not None and config.split_weight:
        excess = (info["split"] / limit - config.split_margin).clamp_min(0.0)
        reward = reward - config.split_weight * excess.square()
    if config.integrity_weight:
        reward = reward - config.integrity_weight * pairs.drift(env.state.x[:, : env.model.robot])
    return config.scale * torch.where(info["finite"], reward, terms["failure"])
