"""Windows of differentiable simulation, with episodes that begin anew on other particle layouts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from baselines.training_reward import Pairs, training_reward
from cfp.vec_env import TorchVecEnv
from dittogym import TorchEnv
from torchmpm.state import choose

if TYPE_CHECKING:
    from baselines.shac import ShacConfig


@dataclass(frozen=True)
class Window:
    """What is learned from, T control steps of B simulations.

    Attributes:
        loss: Negative discounted rewards and final values of the window, mean over simulations and steps; with graph.
        true_reward: Mean over steps and simulations.
        seen: (T, B, ...) what the networks were given.
        rewards: (T, B) training rewards.
        targets: (T, B) TD(lambda) targets of the values of what was seen.
        values: (T, B) the target critic's values after each step.
    """

    loss: Tensor
    true_reward: float
    seen: Tensor
    rewards: Tensor
    targets: Tensor
    values: Tensor


class Rollout:
    """The simulations that are learned from, and what happens to their episodes.

    Element i of the batch is first cut at ``age * (i + 1) / B`` steps, later at ``age``; so not all are young at once.
    A simulation that is not finite is reset like one that has ended, and counted. Gradients that are not finite in one
    action of one simulation are left out and counted; the others stay.

    Args:
        config: The run's options.
        env: The simulations; they are reset.
        look: What the networks are given for their present state.
    """

    def __init__(self, config: ShacConfig, env: TorchEnv, look: Callable[[], Tensor]) -> None:
        self.config, self.env, self.look = config, env, look
        count = env.num_envs
        self.first_layout = config.seed + count  # seeds of single elements are counted back from it, and not below 0
        env.reset(seed=self.first_layout)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.age = min(config.age, env.spec.horizon)
        self.limit = torch.tensor([max(1, self.age * (i + 1) // count) for i in range(count)], device=env.device)
        self.returns = torch.zeros(count, device=env.device)
        self.ended: list[float] = []
        self.drawn = count
        self.counts = {"episodes": 0, "terminated": 0, "nonfinite": 0, "dropped": 0}

    def play(self, actor: Callable[[Tensor], Tensor], value: Callable[[Tensor], Tensor]) -> Window:
        """Make a window.

        Args:
            actor: From what is seen to the mean of actions before tanh, (B, 2, R, R).
            value: From what is seen to the target critic's values (B,).
        """
        env, gamma = self.env, self.config.gamma
        self.ended = []
        total = torch.zeros(env.num_envs, device=env.device)
        discount = torch.ones_like(total)
        seen, rewards, values, ends, truth = [], [], [], [], 0.0
        now, pairs = self.look(), self._pairs()
        for step in range(self.config.window):
            seen.append(now.detach())
            before = env.env_state.centre
            _, smooth, terminated, _, info = env.step(self._act(actor(now)), soft=True)
            reward = training_reward(self.config.reward, env, before, smooth, info, pairs).float()
            truth += float(info["true_reward"].detach().mean())
            self.returns += info["true_reward"].detach()
            after = self.look()
            out = terminated | (env.env_state.steps >= self.limit)
            following = torch.where(terminated, 0.0, value(after))
            total = total + discount * reward
            last = out | (step + 1 == self.config.window)
            total = total + torch.where(last, gamma * discount * following, 0.0)
            discount = torch.where(out, 1.0, gamma * discount)
            rewards.append(reward.detach())
            values.append(following.detach())
            ends.append(out)
            if bool(out.any()):
                self._restart(out, terminated, info["finite"])
                pairs, fresh = self._pairs(), self.look()
                after = choose(out, fresh, after)
            now = after
        targets = self._targets(rewards, values, ends)
        loss = -total.mean() / self.config.window
        parts = map(torch.stack, (seen, rewards, targets, values))
        return Window(loss, truth / self.config.window, *parts)

    def _pairs(self) -> Pairs:
        return Pairs.of(self.env.state.x[:, : self.env.model.robot].detach())

    def _act(self, mean: Tensor) -> Tensor:
        """Actions with noise; a gradient that is not finite ends here, for the whole simulation."""
        noise = torch.randn(mean.shape, generator=self.generator).to(mean)
        action = (mean + self.config.noise * noise).tanh()
        if action.requires_grad:
            action.register_hook(self._drop)
        return action

    def _drop(self, gradient: Tensor) -> Tensor:
        finite = gradient.isfinite().flatten(1).all(1)
        self.counts["dropped"] += int((~finite).sum())
        return torch.where(finite[:, None, None, None], gradient, 0.0)

    def _targets(self, rewards: list[Tensor], values: list[Tensor], ends: list[Tensor]) -> list[Tensor]:
        """TD(lambda) targets (B,) of every step, from the values after it; values of terminated states are zero."""
        mix, targets, later = self.config.td_lambda, [], values[-1]
        for reward, value, end in zip(reversed(rewards), reversed(values), reversed(ends), strict=True):
            later = torch.where(end, value, (1.0 - mix) * value + mix * later)
            later = reward + self.config.gamma * later
            targets.append(later)
        return targets[::-1]

    def _restart(self, out: Tensor, terminated: Tensor, finite: Tensor) -> None:
        """Begin new episodes, each on the next layout."""
        for i in out.nonzero()[:, 0].tolist():
            self.counts["episodes"] += 1
            self.counts["terminated"] += int(terminated[i])
            self.counts["nonfinite"] += int(~finite[i])
            self.ended.append(float(self.returns[i]))
            layout = self.first_layout + self.drawn % self.config.layouts
            self.drawn += 1
            mask = torch.arange(self.env.num_envs, device=self.env.device) == i
            self.env.reset(seed=layout - i, options={"reset_mask": mask})
        self.returns = torch.where(out, 0.0, self.returns)
        self.limit = torch.where(out, self.age, self.limit)

    def scalars(self) -> dict[str, float | None]:
        """Counts, and the mean true return of the episodes that ended in the last window."""
        scalars: dict[str, float | None] = {f"train/{name}": float(count) for name, count in self.counts.items()}
        return scalars | {"rollout/return": float(np.mean(self.ended)) if self.ended else None}

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on besides the networks."""
        return {
            "episodes": TorchVecEnv(self.env).state_dict(),
            "generator": self.generator.get_state(),
            "limit": self.limit.cpu(),
            "returns": self.returns.cpu(),
            "drawn": self.drawn,
            "counts": dict(self.counts),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        TorchVecEnv(self.env).load_state_dict(state["episodes"])
        self.generator.set_state(state["generator"])
        self.limit, self.returns = state["limit"].to(self.limit), state["returns"].to(self.returns)
        self.drawn, self.counts = state["drawn"], dict(state["counts"])
