"""The replay buffer."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from cfp.agent.composition import Composition


class ReplayRing(ReplayBuffer):
    """stable-baselines3's replay buffer, with batches drawn without replacement from a generator of its own.

    With a ``composition``, actions are stored as vectors of their parts and rebuilt in each batch. With ``n_steps``
    above 1, rewards are summed over that many steps with the discount factor ``gamma``, or until the episode or the
    memory ends, and ``discounts`` holds the factor of what follows.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        seed: int | None = None,
        composition: Composition | None = None,
        n_steps: int = 1,
        gamma: float = 1.0,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("optimize_memory_usage"):  # it takes the next row's observation for the next observation
            raise ValueError("optimize_memory_usage must be False, got True: next observations are stored")
        stored = spaces.Box(-np.inf, np.inf, (composition.length,), np.float32) if composition else action_space
        super().__init__(buffer_size, observation_space, stored, *args, **kwargs)
        self.generator = np.random.default_rng(seed)
        self.composition, self.n_steps, self.gamma = composition, n_steps, gamma

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch uniformly, without replacement if at least ``batch_size`` transitions are stored."""
        stored = self.size() * self.n_envs
        indices = self.generator.choice(stored, batch_size, replace=batch_size > stored)
        row, element = np.divmod(indices, self.n_envs)
        rewards, last, discounts = self._look_ahead(row, element)
        terminated = self.dones[last, element] * (1 - self.timeouts[last, element])
        arrays = (
            self._normalize_obs(self.observations[row, element], env),
            self.actions[row, element],
            self._normalize_obs(self.next_observations[last, element], env),
            terminated[:, None],
            self._normalize_reward(rewards[:, None], env),
        )
        # Indexing has made copies already.
        batch = ReplayBufferSamples(*(self.to_torch(np.asarray(array), copy=False) for array in arrays))
        if self.n_steps > 1:
            batch = batch._replace(discounts=self.to_torch(discounts[:, None], copy=False))
        if self.composition is None:
            return batch
        return batch._replace(actions=self.composition.rebuild(batch.actions).flatten(1))

    def _look_ahead(self, row: np.ndarray, element: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Sums of rewards from transitions on, rows of the last ones, and discount factors of what follows."""
        rewards, last = self.rewards[row, element].copy(), row
        discounts = np.full_like(rewards, self.gamma)
        continues = self.dones[row, element] == 0
        for _ in range(self.n_steps - 1):
            after = (last + 1) % self.buffer_size
            continues &= after != self.pos  # the newest row has no successor
            rewards += continues * discounts * self.rewards[after, element]
            discounts = np.where(continues, discounts * np.float32(self.gamma), discounts)
            last = np.where(continues, after, last)
            continues &= self.dones[last, element] == 0
        return rewards, last, discounts
