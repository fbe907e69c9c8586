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

    With a ``composition``, actions are stored as vectors of their parts and rebuilt in each batch.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        *args: Any,
        seed: int | None = None,
        composition: Composition | None = None,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("optimize_memory_usage"):  # it takes the next row's observation for the next observation
            raise ValueError("optimize_memory_usage must be False, got True: next observations are stored")
        stored = spaces.Box(-np.inf, np.inf, (composition.length,), np.float32) if composition else action_space
        super().__init__(buffer_size, observation_space, stored, *args, **kwargs)
        self.generator = np.random.default_rng(seed)
        self.composition = composition

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch uniformly, without replacement if at least ``batch_size`` transitions are stored."""
        stored = self.size() * self.n_envs
        indices = self.generator.choice(stored, batch_size, replace=batch_size > stored)
        row, element = np.divmod(indices, self.n_envs)
        terminated = self.dones[row, element] * (1 - self.timeouts[row, element])
        arrays = (
            self._normalize_obs(self.observations[row, element], env),
            self.actions[row, element],
            self._normalize_obs(self.next_observations[row, element], env),
            terminated[:, None],
            self._normalize_reward(self.rewards[row, element, None], env),
        )
        # Indexing has made copies already.
        batch = ReplayBufferSamples(*(self.to_torch(np.asarray(array), copy=False) for array in arrays))
        if self.composition is None:
            return batch
        return batch._replace(actions=self.composition.rebuild(batch.actions).flatten(1))
