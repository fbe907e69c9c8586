"""Windows of differentiable simulation, within which episodes end and start anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from baselines.common.episodes import Episodes
from baselines.common.stateful import Stateful
from baselines.shac.reward import Neighbours, RewardConfig, training_reward
from cfp.errors import NonFiniteError
from torchmpm import tree


class Window(NamedTuple):
    """T control steps of B simulations, with their autograd graph."""

    observations: Tensor  # (T, B, ...) inputs of the networks, detached
    rewards: Tensor  # (T, B) training rewards
    next_values: Tensor  # (T, B) values of the states after each step; 0 where the task has ended the episode
    done: Tensor  # (T, B) bool, whether the episode was over after the step
    true_reward: float  # mean of the task's own rewards


class Rollout(Stateful):
    """Collects windows from simulations that an actor drives.

    Gradients with respect to the action of one simulation in one step that are not finite are left out and counted.
    """

    parts, values = ("episodes",), ("generator",)

    def __init__(
        self,
        episodes: Episodes,
        observe: Callable[[], Tensor],
        reward: RewardConfig,
        steps: int,
        noise: float,
        seed: int,
    ) -> None:
        self.env, self.episodes, self.observe, self.reward = episodes.env, episodes, observe, reward
        self.steps, self.noise = steps, noise
        self.generator = torch.Generator().manual_seed(seed)
        self.episodes.counts["dropped"] = 0

    def collect(self, actor: Callable[[Tensor], Tensor], value: Callable[[Tensor], Tensor]) -> Window:
        """Collect the next window; ``actor`` maps observations to means before tanh, ``value`` maps them to values."""
        env, true_reward = self.env, 0.0
        steps: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        observation, neighbours = self.observe(), Neighbours.find(self._robot_positions())
        for _ in range(self.steps):
            centre = env.env_state.centre
            _, smooth_reward, terminated, _, info = env.step(self._act(actor(observation)), soft=True)
            reward = training_reward(self.reward, env, centre, smooth_reward, info, neighbours).float()
            next_observation = self.observe()
            next_value = torch.where(terminated, 0.0, value(next_observation))
            true_reward += float(info["true_reward"].detach().mean())
            is_over = self.episodes.record(info["true_reward"].detach(), terminated)
            steps.append((observation.detach(), reward, next_value, is_over))
            if bool(is_over.any()):
                self.episodes.restart(is_over, terminated, info["finite"])
                neighbours = tree.where(is_over, Neighbours.find(self._robot_positions()), neighbours)
                next_observation = tree.where(is_over, self.observe(), next_observation)
            observation = next_observation
        observations, rewards, next_values, done = (torch.stack(values) for values in zip(*steps, strict=True))
        return Window(observations, rewards, next_values, done, true_reward / self.steps)

    def _robot_positions(self) -> Tensor:
        return self.env.state.x[:, : self.env.model.num_robot_particles].detach()

    def _act(self, mean: Tensor) -> Tensor:
        noise = torch.randn(mean.shape, generator=self.generator).to(mean)
        action = (mean + self.noise * noise).tanh()
        if not bool(action.isfinite().all()):
            raise NonFiniteError("the actor's actions became NaN or infinite; the last checkpoint is untouched")
        if action.requires_grad:
            action.register_hook(self._drop_nonfinite)
        return action

    def _drop_nonfinite(self, gradient: Tensor) -> Tensor:
        finite = gradient.isfinite().flatten(1).all(1)
        self.episodes.counts["dropped"] += int((~finite).sum())
        return torch.where(finite[:, None, None, None], gradient, 0.0)
