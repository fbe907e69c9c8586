"""The smooth reward that gradients maximise in place of a task's own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from cfp.config import WindowConfig
from dittogym import TorchEnv, core
from dittogym.rewards import Reward, Transition
from dittogym.spec import TaskSpec
from torchmpm import tree

#: Reward for a mean speed of 1 m/s.
SPEED_WEIGHT = 60.0
#: Neighbours of each sampled particle whose distance is tracked, and how many particles are sampled at most.
NEIGHBOURS, MAX_SAMPLES = 6, 500
#: Particles nearer than this, m, belong together.
RADIUS = 0.03
#: Fraction of ``RADIUS`` by which they may drift apart at no cost.
TOLERANCE = 0.25


@tree.register
@dataclass(frozen=True)
class Neighbours:
    """Pairs of a robot's particles that were close to each other; tearing shows in them before the body is split."""

    index: Tensor  # (B, K) numbers of the sampled particles
    neighbours: Tensor  # (B, K, M) their nearest other samples, numbers among the samples
    distance: Tensor  # (B, K, M), m, when they were found
    is_close: Tensor  # (B, K, M) bool, whether they were nearer than `RADIUS`

    @classmethod
    @torch.no_grad()
    def find(cls, x: Tensor) -> Neighbours:
        """Find neighbours among a robot's particles (B, N, 2), m."""
        count = min(MAX_SAMPLES, x.shape[1])
        index = torch.linspace(0, x.shape[1] - 1, count, device=x.device).long()
        samples = x[:, index] - x.mean(1, keepdim=True)  # cdist loses digits far from the origin
        nearest = torch.cdist(samples, samples).topk(min(NEIGHBOURS + 1, count), largest=False)
        distance, neighbours = nearest.values[..., 1:], nearest.indices[..., 1:]  # the first is the particle itself
        return cls(index.expand(len(x), -1), neighbours, distance, distance < RADIUS)

    def drift(self, x: Tensor) -> Tensor:
        """Mean over close pairs, (B,), of the square of ``(d - d_0) / RADIUS - TOLERANCE`` where it is positive."""
        samples = x.gather(1, self.index[..., None].expand(-1, -1, 2))
        index = self.neighbours.flatten(1)[..., None].expand(-1, -1, 2)
        gap = samples.gather(1, index).view(*self.neighbours.shape, 2) - samples[:, :, None]
        distance = (gap.square().sum(-1) + 1e-12).sqrt()
        excess = ((distance - self.distance) / RADIUS - TOLERANCE).clamp_min(0.0) * self.is_close
        return excess.square().sum((1, 2)) / self.is_close.sum((1, 2)).clamp_min(1)


def discount_rate(gamma: float) -> float:
    """1 - gamma, at least 0.01: a value sums up the rewards of 1 / (1 - gamma) steps, here at most 100."""
    return max(1.0 - gamma, 1e-2)


def success_value(config: WindowConfig) -> float:
    """Value of the end of an episode that ended in success."""
    return config.reward_scale * config.success_reward / discount_rate(config.gamma)


def split_cost(split: Tensor, limit: float, margin: float, weight: float) -> Tensor:
    """Cost (B,) of robots' spread (B,), m, beyond a fraction ``margin`` of the ``limit`` at which they are torn."""
    return weight * (split / limit - margin).clamp_min(0.0).square()


def training_reward(
    config: WindowConfig,
    env: TorchEnv,
    previous_centre: Tensor,
    reward: Tensor,
    info: dict[str, Any],
    neighbours: Neighbours,
) -> Tensor:
    """Training reward (B,) of the environment's last step."""
    terms = info["reward_terms"]
    if config.reward == "speed":
        seconds = env.model.substeps * env.model.solver.dt
        reward = SPEED_WEIGHT / seconds * (info["com"] - previous_centre)[:, 0] + terms["failure"]
        if "action" in terms:
            reward = reward + terms["action"]
    limit = env.spec.split_limit
    if limit is not None and config.split_weight:
        reward = reward - split_cost(info["split"], limit, config.split_margin, config.split_weight)
    if config.integrity_weight:
        reward = reward - config.integrity_weight * neighbours.drift(env.state.x[:, : env.model.num_robot_particles])
    return config.reward_scale * torch.where(info["finite"], reward, terms["failure"])


def has_gradient(env: TorchEnv) -> bool:
    """Whether a term of the task's own reward, made smooth, has a gradient in the next action.

    The reward as a whole always has one: the environment adds a cost of actions and of tearing.
    """
    differentiable: list[bool] = []

    def reward_fn(transition: Transition, spec: TaskSpec) -> Reward:
        outcome = env.spec.reward_fn(transition, spec)
        differentiable.extend(term.requires_grad for term in outcome.terms.values())
        return outcome

    shape = (env.num_envs, *env.action_shape)
    with torch.enable_grad():
        action = torch.zeros(shape, dtype=env.dtype, device=env.device, requires_grad=True)
        core.step(replace(env.model, spec=replace(env.spec, reward_fn=reward_fn)), env.env_state, action, soft=True)
    return any(differentiable)
