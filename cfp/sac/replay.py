"""The replay buffer, in main memory or on a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor

from cfp.errors import ConfigError
from dittogym.copies import to_device

#: What a replay buffer holds of each transition, with a leading (rows, n_envs).
FIELDS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
#: Largest part of a GPU's free memory that transitions may take; the simulation and the updates need the rest.
ROOM = 0.7


class ReplayRing(ReplayBuffer):
    """stable-baselines3's replay buffer, with batches drawn from a generator of its own, and a place on a GPU.

    By default the fields are arrays, and batches are drawn without replacement. With ``tensors`` the fields are tensors
    on the device, and batches are drawn with replacement, so that nothing is copied from there or waited for.

    With an ``action_size``, actions are stored as (2, size, size). With ``n_steps`` above 1, rewards are summed over
    that many steps with the discount factor ``gamma``, or until the episode or the memory ends, and ``discounts`` holds
    the factor of what follows.

    Raises:
        ConfigError: A GPU has too little free memory for ``buffer_size`` transitions.
    """

    observations: Any  # uint8 (rows, n_envs, 3, 64, 64); an array or a tensor, like the other fields
    next_observations: Any
    actions: Any  # float32 (rows, n_envs, length)
    rewards: Any  # float32 (rows, n_envs), like those below
    dones: Any
    timeouts: Any

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: torch.device | str = "auto",
        n_envs: int = 1,
        *args: Any,
        seed: int | None = None,
        action_size: int | None = None,
        n_steps: int = 1,
        gamma: float = 1.0,
        tensors: bool = False,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("optimize_memory_usage"):  # it takes the next row's observation for the next observation
            raise ValueError("optimize_memory_usage must be False, got True: next observations are stored")
        stored = spaces.Box(-np.inf, np.inf, (2, action_size, action_size), np.float32) if action_size else action_space
        # Of what becomes tensors, stable-baselines3 makes a single row, which has the shapes and types.
        super().__init__(n_envs if tensors else buffer_size, observation_space, stored, device, n_envs, *args, **kwargs)
        self.generator: np.random.Generator | torch.Generator = np.random.default_rng(seed)
        self.action_size, self.n_steps, self.gamma = action_size, n_steps, gamma
        if tensors:
            self.buffer_size = max(buffer_size // n_envs, 1)
            self.generator = torch.Generator(self.device).manual_seed(seed or 0)
            rows = {name: torch.from_numpy(getattr(self, name)) for name in FIELDS}
            check_room(buffer_size, sum(row.nbytes for row in rows.values()) // n_envs, self.device)
            for name, row in rows.items():
                setattr(self, name, row.to(self.device).repeat(self.buffer_size, *[1] * (row.ndim - 1)))

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store a step of all environments, see stable-baselines3; images and actions may be tensors."""
        if isinstance(self.rewards, np.ndarray):
            super().add(obs, next_obs, action, reward, done, infos)
            return
        timeouts = np.array([info.get("TimeLimit.truncated", False) for info in infos])
        row: tuple[Any, ...] = obs, next_obs, action, reward, done, timeouts
        for name, given in zip(FIELDS, row, strict=True):
            place: Tensor = getattr(self, name)[self.pos]
            values = given if isinstance(given, Tensor) else to_device(given, self.device)
            place.copy_(values.reshape(place.shape))
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def cut(self) -> None:
        """Let sums of rewards end with the newest transitions, as at a time limit: the environment is reset now."""
        if self.size():
            newest = self.pos - 1
            self.timeouts[newest] += 1 - self.dones[newest]
            self.dones[newest] = 1

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Draw a batch uniformly; from arrays without replacement if at least ``batch_size`` transitions are stored."""
        first = self._draw(batch_size)
        rewards, last, discounts = self._look_ahead(first)
        terminated = self._take("dones", last) * (1 - self._take("timeouts", last))
        fields = (
            self._normalize_obs(self._take("observations", first), env),
            self._take("actions", first),
            self._normalize_obs(self._take("next_observations", last), env),
            terminated[:, None],
            self._normalize_reward(rewards[:, None], env),
        )
        # Indexing has made copies already.
        batch = ReplayBufferSamples(*(torch.as_tensor(values, device=self.device) for values in fields))
        if self.n_steps > 1:
            batch = batch._replace(discounts=torch.as_tensor(discounts[:, None], device=self.device))
        return batch

    def _draw(self, batch_size: int) -> Any:
        """Numbers (batch_size,) of stored transitions, counted row by row."""
        stored = self.size() * self.n_envs
        if isinstance(self.generator, torch.Generator):
            return torch.randint(stored, (batch_size,), generator=self.generator, device=self.device)
        return self.generator.choice(stored, batch_size, replace=batch_size > stored)

    def _take(self, name: str, index: Any) -> Any:
        """Values of a field of the transitions with these numbers."""
        field = getattr(self, name)
        return field.reshape(-1, *field.shape[2:])[index]

    def _look_ahead(self, index: Any) -> tuple[Any, Any, Any]:
        """Sums of rewards from transitions on, numbers of the last ones, and discount factors of what follows."""
        library = torch if isinstance(index, Tensor) else np  # functions of the same names
        rewards = self._take("rewards", index)
        discounts = library.full_like(rewards, self.gamma)
        continues = self._take("dones", index) == 0
        for _ in range(self.n_steps - 1):
            after = (index + self.n_envs) % (self.buffer_size * self.n_envs)
            continues &= after // self.n_envs != self.pos  # the newest row has no successor
            rewards += continues * discounts * self._take("rewards", after)
            discounts = library.where(continues, discounts * np.float32(self.gamma), discounts)
            index = library.where(continues, after, index)
            continues &= self._take("dones", index) == 0
        return rewards, index, discounts


def check_room(count: int, size: int, device: torch.device) -> None:
    """Refuse a memory of ``count`` transitions of ``size`` bytes for which a GPU has no room."""
    if device.type == "cpu":
        return
    free, _ = torch.cuda.mem_get_info(device)
    if count * size > (allowed := ROOM * free):
        raise ConfigError(
            f"buffer_size must be at most {int(allowed) // size:,} on this GPU, of which {free / 1e9:.1f} GB are free, "
            f"got {count:,}, which take {count * size / 1e9:.1f} GB"
        )
