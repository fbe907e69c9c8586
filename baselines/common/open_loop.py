"""An open-loop policy: the same sequence of actions in every episode."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from torch import Tensor

from cfp.hub import Shareable
from cfp.learner import Learner, Scalars
from cfp.policy import Memory, Observation, Start, read_policy, report_mismatch, write_policy


class OpenLoop(Shareable):
    """Plays a sequence of actions from the beginning of an episode; after the last one its actions are zero.

    Args:
        actions: (T, 2, R, R), in [-1, 1].
        description: What it is and comes from.

    Raises:
        ValueError: The actions have another shape.
    """

    deterministic_by_default = True
    uses_image = False

    def __init__(self, actions: Tensor, description: dict[str, Any] | None = None) -> None:
        if actions.ndim != 4 or actions.shape[1] != 2 or actions.shape[2] != actions.shape[3]:
            raise ValueError(f"actions must have shape (T, 2, R, R), got {tuple(actions.shape)}")
        self.actions = actions.detach().float().cpu()
        self.description = description or {}

    @property
    def resolution(self) -> int:
        """Action grid R."""
        return self.actions.shape[-1]

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Actions for the next step, as stable-baselines3's ``predict`` of a policy with memory.

        Args:
            observation: (B, 3, 64, 64) or (3, 64, 64); only the number of images matters.
            state: What the last call returned, None at the beginning: the number of the step, (B,).
            episode_start: (B,) bool, which elements begin anew.
            deterministic: Changes nothing.

        Returns:
            Actions (B, 2, R, R), or (2, R, R) for one image, and the memory for the next step.
        """
        single = isinstance(observation, np.ndarray) and observation.ndim == 3
        count = 1 if single else len(observation)
        step = np.zeros(count, np.int64) if state is None else state[0]
        if episode_start is not None:
            step = np.where(episode_start, 0, step)
        actions = np.zeros((count, *self.actions.shape[1:]), np.float32)
        playing = step < len(self.actions)
        actions[playing] = self.actions.numpy()[step[playing]]
        return actions[0] if single else actions, (step + 1,)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``path``, which must end in ``.safetensors``, and a description beside it, which ends in ``.json``."""
        write_policy(path, {"actions": self.actions}, self.description)

    @classmethod
    def load(cls, path: Path) -> OpenLoop:
        """Load what `save` wrote; a `CheckpointError` if it is missing, damaged, or not such a policy."""
        tensors, description = read_policy(path)
        with report_mismatch(path):
            return cls(tensors["actions"], description)


class OpenLoopLearner(Learner):
    """A planner or an optimiser of actions; its policy is a sequence of actions, and no network is trained."""

    finished: bool = False  # whether the episode is over before the last step

    @property
    def trained_policy(self) -> OpenLoop:
        """The sequence so far."""
        raise NotImplementedError

    @property
    def progress(self) -> float:
        """Fraction of the stage that is done, 0 to 1."""
        return min(self.num_timesteps / self.config.stage_steps(self.stage), 1.0)

    def update(self) -> Scalars:
        """Take some environment steps, add them to `num_timesteps`, and return scalars to log."""
        raise NotImplementedError

    @property
    def logger(self) -> Logger:
        """Where scalars go."""
        return self._logger

    def set_logger(self, logger: Logger) -> None:
        """Set where scalars go."""
        self._logger = logger

    def learn(
        self,
        total_timesteps: int,
        callback: BaseCallback,
        log_interval: int | None = None,
        *,
        reset_num_timesteps: bool = True,
    ) -> None:
        """Take at least ``total_timesteps`` more environment steps, with the callbacks of stable-baselines3.

        ``log_interval`` and ``reset_num_timesteps`` have no effect: callbacks write the rows, and steps are counted on.
        """
        callback.init_callback(cast(BaseAlgorithm, self))
        callback.on_training_start(locals(), globals())
        end = self.num_timesteps + total_timesteps
        while self.num_timesteps < end and not self.finished:
            callback.on_rollout_start()
            for name, value in self.update().items():
                self.logger.record(name, value)
            callback.on_step()
        callback.on_training_end()

    @classmethod
    def load_policy(cls, path: Path, device: str = "cpu") -> OpenLoop:
        """Load actions."""
        return OpenLoop.load(path)
