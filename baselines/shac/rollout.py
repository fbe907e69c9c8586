"""Windows of differentiable simulation, with episodes that begin anew on other particle layouts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from baselines.common.episodes import Episodes
from baselines.shac.reward import Neighbours, training_reward
from cfp.errors import NonFiniteError
from dittogym import TorchEnv
from torchmpm import tree

if TYPE_CHECKING:
    from baselines.shac.train import ShacConfig


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

    Gradients that are not finite in one action of one simulation are left out and counted; the others stay.

    Args:
        config: The run's options.
        env: The simulations; they are reset.
        look: What the networks are given for their present state.
    """

    def __init__(self, config: ShacConfig, env: TorchEnv, look: Callable[[], Tensor]) -> None:
        self.config, self.env, self.look = config, env, look
        self.episodes = Episodes(env, config.seed, config.max_episode_steps, config.num_layouts)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.episodes.counts["dropped"] = 0

    def play(self, actor: Callable[[Tensor], Tensor], value: Callable[[Tensor], Tensor]) -> Window:
        """Make a window.

        Args:
            actor: From what is seen to the mean of actions before tanh, (B, 2, R, R).
            value: From what is seen to the target critic's values (B,).

        Raises:
            NonFiniteError: The actor's actions are not finite.
        """
        env, gamma = self.env, self.config.gamma
        total = torch.zeros(env.num_envs, device=env.device)
        discount = torch.ones_like(total)
        seen, rewards, values, ends, truth = [], [], [], [], 0.0
        now, pairs = self.look(), Neighbours.find(self._places())
        for step in range(self.config.window):
            seen.append(now.detach())
            before = env.env_state.centre
            _, smooth, terminated, _, info = env.step(self._act(actor(now)), soft=True)
            reward = training_reward(self.config.reward, env, before, smooth, info, pairs).float()
            truth += float(info["true_reward"].detach().mean())
            self.episodes.returns += info["true_reward"].detach()
            after = self.look()
            out = self.episodes.over(terminated)
            following = torch.where(terminated, 0.0, value(after))
            total = total + discount * reward
            last = out | (step + 1 == self.config.window)
            total = total + torch.where(last, gamma * discount * following, 0.0)
            discount = torch.where(out, 1.0, gamma * discount)
            rewards.append(reward.detach())
            values.append(following.detach())
            ends.append(out)
            if bool(out.any()):
                self.episodes.restart(out, terminated, info["finite"])
                pairs = tree.where(out, Neighbours.find(self._places()), pairs)
                after = tree.where(out, self.look(), after)
            now = after
        targets = self._targets(rewards, values, ends)
        loss = -total.mean() / self.config.window
        parts = map(torch.stack, (seen, rewards, targets, values))
        return Window(loss, truth / self.config.window, *parts)

    def _places(self) -> Tensor:
        """The robots' particles (B, N, 2), m."""
        return self.env.state.x[:, : self.env.model.robot].detach()

    def _act(self, mean: Tensor) -> Tensor:
        """Actions with noise; a gradient that is not finite ends here, for the whole simulation."""
        noise = torch.randn(mean.shape, generator=self.generator).to(mean)
        action = (mean + self.config.noise * noise).tanh()
        if not bool(action.isfinite().all()):
            raise NonFiniteError("the actor's actions became NaN or infinite; the last checkpoint is untouched")
        if action.requires_grad:
            action.register_hook(self._drop)
        return action

    def _drop(self, gradient: Tensor) -> Tensor:
        finite = gradient.isfinite().flatten(1).all(1)
        self.episodes.counts["dropped"] += int((~finite).sum())
        return torch.where(finite[:, None, None, None], gradient, 0.0)

    def _targets(self, rewards: list[Tensor], values: list[Tensor], ends: list[Tensor]) -> list[Tensor]:
        """TD(lambda) targets (B,) of every step, from the values after it; values of terminated states are zero."""
        mix, targets, later = self.config.td_lambda, [], values[-1]
        for reward, value, end in zip(reversed(rewards), reversed(values), reversed(ends), strict=True):
            later = torch.where(end, value, (1.0 - mix) * value + mix * later)
            later = reward + self.config.gamma * later
            targets.append(later)
        return targets[::-1]

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next window depends on besides the networks."""
        return self.episodes.state_dict() | {"generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self.episodes.load_state_dict(state)
        self.generator.set_state(state["generator"])
