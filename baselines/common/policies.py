"""Policies that act on the state of a simulation instead of the image."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from cfp.hub import Shareable
from cfp.policy import Memory, Observation, Start
from dittogym import TorchEnv
from dittogym.spec import TaskSpec
from torchmpm import checks

Network = TypeVar("Network", bound=nn.Module)


class StateBasedPolicy(Shareable, ABC):
    """A policy that acts on the state of the environment given to `attached`; the image is not looked at."""

    uses_image = False
    env: TorchEnv | None = None

    def __init__(self, description: dict[str, Any] | None = None) -> None:
        self.description = description or {}

    @property
    def deterministic_by_default(self) -> bool:
        """Whether the run that trained it evaluates it without noise."""
        return bool(self.description.get("deterministic", False))

    @property
    @abstractmethod
    def num_inputs(self) -> int:
        """Number of features that the network takes."""

    @abstractmethod
    def num_features(self, spec: TaskSpec) -> int:
        """Number of features that a task has."""

    def attached(self, env: TorchEnv) -> StateBasedPolicy:
        """Return the same policy, acting on the state of an environment.

        Args:
            env: The environment; that of a Gymnasium environment is ``env.unwrapped.torch_env``.

        Raises:
            TypeError: ``env`` is not a `dittogym.TorchEnv`.
            ValueError: The environment is of a task with another number of features.
        """
        checks.instance("env", env, TorchEnv)
        found = self.num_features(env.spec)
        if found != self.num_inputs:
            raise ValueError(
                f"env must be of a task with {self.num_inputs} features, got {env.spec.name!r} with {found}"
            )
        policy = copy.copy(self)
        policy.env = env
        return policy

    @torch.no_grad()
    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Choose actions for the present state of the attached environment, with the signature of stable-baselines3.

        Args:
            observation: (B, 3, 64, 64) or (3, 64, 64); only the number of images matters.
            state: Memory that the last call returned, arrays with a leading B; None at the beginning.
            episode_start: (B,) bool; ignored, as the environment knows which of its episodes begin.
            deterministic: Act without noise.

        Returns:
            Actions (B, 2, R, R) float32, or (2, R, R) for a single image, and the memory for the next call.

        Raises:
            RuntimeError: The policy was not attached to an environment.
            ValueError: The number of images is not that of the environment's simulations.
        """
        if self.env is None:
            raise RuntimeError("this policy acts on the state of the simulation: call attached(env) first")
        single = isinstance(observation, np.ndarray) and observation.ndim == 3
        if (count := 1 if single else len(observation)) != self.env.num_envs:
            raise ValueError(f"observation must have {self.env.num_envs} images as the environment, got {count}")
        actions, state = self._act(self.env, state, deterministic)
        array = actions.float().cpu().numpy()
        return array[0] if single else array, state

    @abstractmethod
    def _act(self, env: TorchEnv, state: Memory, deterministic: bool) -> tuple[Tensor, Memory]:
        """Actions (B, 2, R, R) for the state of an environment, and the memory for the next step."""


def load_network(build: Callable[[], Network], tensors: Mapping[str, Tensor], device: str) -> Network:
    """Build a network for inference from its weights; a size that a file only claims takes no memory."""
    with torch.device("meta"):
        network = build()
    network.load_state_dict(tensors, assign=True)
    return network.to(device, torch.float32).requires_grad_(False)
