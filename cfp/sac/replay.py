"""The replay buffer, and the compact form in which it keeps composed actions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor

from cfp.agent.actor import ActorSpec, Interpolation, compose


@dataclass(frozen=True)
class Composition:
    """Structure of a vector that holds the parts of a composed action, see `cfp.agent.actor.compose`."""

    resolutions: tuple[int, ...]  # Action grid R of each stage, coarsest first
    size: int  # Rows and columns of the composed action as critics take it
    interpolation: Interpolation

    @classmethod
    def of(cls, spec: ActorSpec) -> Composition | None:
        """Composition of an actor; None if critics take the executed action, and it is no larger than its parts."""
        if spec.patch is None:
            return None
        composition = cls(spec.resolutions, spec.critic_size, spec.interpolation)
        smaller = composition.length < 2 * spec.action_size**2
        return composition if smaller or spec.critic_size < spec.action_size else None

    @property
    def grids(self) -> tuple[int, ...]:
        """Action grid R of each part."""
        return (self.resolutions[0], *(grid for grid in self.resolutions[1:] for _ in range(2)))

    @property
    def length(self) -> int:
        """Number of entries of a vector."""
        return sum(2 * grid**2 for grid in self.grids)

    def join(self, parts: Sequence[Tensor]) -> Tensor:
        """Concatenate parts (B, 2, R, R) to vectors (B, length)."""
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    def split(self, vectors: Tensor) -> list[Tensor]:
        """Undo `join`."""
        pieces = vectors.split([2 * grid**2 for grid in self.grids], dim=1)
        return [piece.unflatten(1, (2, grid, grid)) for piece, grid in zip(pieces, self.grids, strict=True)]

    def from_finest(self, action: Tensor) -> Tensor:
        """Vectors (B, length) for actions (B, 2, R, R) of the last stage with fully open gates."""
        coarser = action.new_zeros(len(action), self.length - 2 * action[0].numel())
        return self.join([coarser, action, torch.ones_like(action)])

    def rebuild(self, vectors: Tensor) -> Tensor:
        """Compose actions (B, 2, size, size) from vectors (B, length) as the actor does, up to rounding."""
        return compose(self.split(vectors), self.size, self.interpolation)


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
