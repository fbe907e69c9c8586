"""A trained actor on its own, for acting; independent of stable-baselines3, so that loading a policy is quick."""

from __future__ import annotations

import copy
import os
from typing import Any, TypeAlias

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor, nn

from cfp.agent.actor import Actor, build_actor
from cfp.agent.spec import ActorSpec
from cfp.files import write_policy
from cfp.hub import Shareable
from dittogym.observation import SHAPE

# Arguments of `predict` in stable-baselines3.
Observation: TypeAlias = np.ndarray | dict[str, np.ndarray]
Memory: TypeAlias = tuple[np.ndarray, ...] | None
Start: TypeAlias = np.ndarray | None


def check_images(observation: object) -> None:
    """Refuse anything but a uint8 image or a batch of them: networks take other numbers as normalised already."""
    if not isinstance(observation, np.ndarray):
        found = type(observation).__name__ + ("; call its numpy()" if isinstance(observation, Tensor) else "")
    elif observation.dtype == np.uint8 and observation.shape[-3:] == SHAPE and observation.ndim in (3, 4):
        return
    else:
        found = f"{observation.dtype} array of shape {observation.shape}"
    raise ValueError(f"observation must be a uint8 array of shape (3, 64, 64) or (B, 3, 64, 64), got {found}")


class ActorPolicy(nn.Module, Shareable):
    """An actor with stable-baselines3's ``predict``; `cfp.load` returns one.

    Args:
        spec: Structure of the actor.
        deterministic_by_default: Whether the run that trained it evaluates it without noise.
        actor: Of that structure; None: one with random weights.
    """

    uses_image = True

    def __init__(self, spec: ActorSpec, deterministic_by_default: bool = False, actor: Actor | None = None) -> None:
        super().__init__()
        self.spec = spec
        self.deterministic_by_default = deterministic_by_default
        self.description: dict[str, Any] = {}
        self.actor = (build_actor(spec) if actor is None else actor).requires_grad_(False)
        self.observation_space = spaces.Box(0, 255, SHAPE, np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (2, self.resolution, self.resolution), np.float32)

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions, for ``gymnasium.make(..., resolution=...)``."""
        return self.spec.action_size

    def forward(self, observation: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (B, 2, R, R) for a uint8 ``observation`` (B, 3, 64, 64), without noise if ``deterministic``."""
        action: Tensor = self.actor(observation, deterministic)
        return action

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``path``, which must end in ``.safetensors``, and a description beside it, which ends in ``.json``."""
        write_policy(path, self.actor.state_dict(), self.description)

    @torch.no_grad()
    def predict(
        self, observation: Observation, state: Memory = None, episode_start: Start = None, deterministic: bool = False
    ) -> tuple[np.ndarray, Memory]:
        """Choose actions, with the signature of stable-baselines3's ``predict``.

        Args:
            observation: (3, 64, 64) or (B, 3, 64, 64) uint8.
            state: Hidden state with leading B, returned as it is: the policy has no memory.
            episode_start: (B,) bool, without effect.
            deterministic: Act without noise.

        Returns:
            Actions (2, R, R) or (B, 2, R, R) float32, and ``state``.

        Raises:
            ValueError: The observation is neither an image nor a batch of images.
        """
        check_images(observation)
        assert isinstance(observation, np.ndarray)
        action, _ = self.predict_with_gate(observation.reshape(-1, *SHAPE), deterministic)
        return action if observation.ndim == 4 else action[0], state

    @torch.no_grad()
    def predict_with_gate(
        self, observation: np.ndarray, deterministic: bool = False
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Choose actions, and tell where they replace those of the coarser stages.

        Args:
            observation: (B, 3, 64, 64) uint8.
            deterministic: Act without noise.

        Returns:
            Actions (B, 2, A, A) float32, A the policy's resolution, and the gate of the last stage (B, 2, R, R), 0
            where the coarser action is kept; ``None`` for a policy of one stage.
        """
        batch = torch.as_tensor(observation, device=next(self.parameters()).device)
        sample = self.actor.sample(batch, deterministic)
        # This rounds as stable-baselines3 does when it maps [-1, 1] to the bounds of the space.
        action: np.ndarray = (sample.action.cpu().numpy() + 1) - 1
        return action, None if sample.gate is None else sample.gate.cpu().numpy()


def image_policy(spec: ActorSpec, actor: Actor, deterministic: bool) -> ActorPolicy:
    """Policy with a copy of an actor, on its device; takes no numbers from torch's generator."""
    return ActorPolicy(spec, deterministic, copy.deepcopy(actor))
