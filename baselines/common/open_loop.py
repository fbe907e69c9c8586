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
    """A policy that plays a sequence of actions from the beginning of an episode, and zero actions after the last one.

    Args:
        actions: (T, 2, R, R) in [-1, 1].
        description: What it is and where it comes from, see `cfp.policy.Policy.description`; None for nothing.

    Attributes:
        actions: (T, 2, R, R) float32 on the CPU.
        description: What it is and where it comes from.

    Raises:
        ValueError: ``actions`` has another shape.

    Examples:
        >>> import baselines, dittogym, torch
        >>> policy = baselines.OpenLoop(torch.zeros(30, 2, 8, 8))
        >>> env = dittogym.TorchEnv("shapematch", resolution=policy.resolution, particles=300, substeps=10)
        >>> len(env.film(policy, max_steps=3).rewards)
        3
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
        """R, rows and columns of its actions."""
        return self.actions.shape[-1]

    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Return the actions of the next step, with the signature of stable-baselines3's ``predict``.

        Args:
            observation: (B, 3, 64, 64) or (3, 64, 64); only the number of images matters.
            state: Memory that the last call returned, the number of the next step (B,); None at the beginning.
            episode_start: (B,) bool, true for elements that begin anew.
            deterministic: Without effect.

        Returns:
            Actions (B, 2, R, R) float32, or (2, R, R) for one image, and the memory for the next call.
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
        """Write the policy to a file ``.safetensors``, and its description to a file ``.json`` beside it.

        Args:
            path: The file, whose name ends in ``.safetensors``.

        Raises:
            cfp.ConfigError: ``path`` has another suffix, or ``description`` is not complete, as it is for a policy that
                comes from no run.
        """
        write_policy(path, {"actions": self.actions}, self.description)

    @classmethod
    def load(cls, path: Path) -> OpenLoop:
        """Load a policy that `save` wrote.

        Args:
            path: The file ``.safetensors``, or another form that `cfp.load` takes.

        Raises:
            cfp.CheckpointError: The file is missing, damaged, or not such a policy.
        """
        tensors, description = read_policy(path)
        with report_mismatch(path):
            return cls(tensors["actions"], description)


class OpenLoopLearner(Learner):
    """Base class of planners and optimisers of actions, whose policy is a `baselines.OpenLoop`; no network is trained.

    Subclasses implement `update`, `trained_policy` and the other abstract methods of `cfp.learner.Learner`.

    Attributes:
        finished: Whether the episode is over before the last step, which ends `learn`.
    """

    finished: bool = False

    @property
    def trained_policy(self) -> OpenLoop:
        """The sequence of actions so far."""
        raise NotImplementedError

    @property
    def progress(self) -> float:
        """Fraction of the stage that is done, from 0 to 1."""
        return min(self.num_timesteps / self.config.stage_steps(self.stage), 1.0)

    def update(self) -> Scalars:
        """Take some environment steps, and add their number to ``num_timesteps``.

        Returns:
            Scalars to log, by name; None for values that do not exist yet.
        """
        raise NotImplementedError

    @property
    def logger(self) -> Logger:
        """Where scalars are logged, a logger of stable-baselines3."""
        return self._logger

    def set_logger(self, logger: Logger) -> None:
        """Set where scalars are logged, a ``logger`` of stable-baselines3."""
        self._logger = logger

    def learn(
        self,
        total_timesteps: int,
        callback: BaseCallback,
        log_interval: int | None = None,
        *,
        reset_num_timesteps: bool = True,
    ) -> None:
        """Call `update` until the steps are taken or the episode is over.

        Args:
            total_timesteps: Environment steps to take at least.
            callback: A callback of stable-baselines3; the callbacks of a run log, evaluate and write checkpoints.
            log_interval: Without effect: callbacks write the rows of the logs.
            reset_num_timesteps: Without effect: steps are counted on.
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
        """Load a policy that ``save_policy`` wrote to ``path``; ``device`` has no effect."""
        return OpenLoop.load(path)
