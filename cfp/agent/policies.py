"""The stable-baselines3 face of the networks: a `SACPolicy` whose actor is a ladder of action resolutions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac import policies as sac_policies
from torch import nn

from cfp.agent.actor import Actor, SquashedActor, build_actor
from cfp.agent.networks import IMAGE_SIZE, TwinCritic
from cfp.agent.spec import ActorSpec


def observation_space() -> spaces.Box:
    """The image that every network reads: occupancy and velocity, uint8 (3, 64, 64)."""
    return spaces.Box(0, 255, (3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)


def action_space(resolution: int) -> spaces.Box:
    """Muscle activations in [-1, 1], float32 (2, R, R)."""
    return spaces.Box(-1.0, 1.0, (2, resolution, resolution), np.float32)


def check_images(observation: object) -> None:
    """Check what a policy of the image is shown: its networks would take other numbers as mapped already.

    Raises:
        ValueError: It is not an image, or a batch of them.
    """
    found = type(observation).__name__
    if isinstance(observation, np.ndarray):
        if observation.dtype == np.uint8 and observation.shape[-3:] == (3, IMAGE_SIZE, IMAGE_SIZE):
            if observation.ndim in (3, 4):
                return
        found = f"{observation.dtype} array of shape {observation.shape}"
    raise ValueError(f"observation: got {found}, allowed a uint8 array (3, 64, 64) or (B, 3, 64, 64)")


class NetworkPolicy(sac_policies.SACPolicy, ABC):
    """Actor, twin critics and target critics of a kind that a subclass makes, for `cfp.agent.sac.CFP`.

    Args:
        observation_space: What the networks read, as it is (``normalize_images`` is off).
        action_space: Values in [-1, 1].
        lr_schedule: Learning rate of both optimisers as a function of the remaining progress.
        use_sde: Accepted because stable-baselines3 passes it; must be False.
        optimizer_class: Optimiser of actor and critics.
        optimizer_kwargs: Its options except the learning rate; a fused Adam if None.

    Raises:
        ValueError: ``use_sde`` is set.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        use_sde: bool = False,
        optimizer_class: type[torch.optim.Optimizer] = torch.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        """Build the networks and their optimisers."""
        if use_sde:
            raise ValueError("use_sde: got True, allowed False (the policy has its own exploration noise)")
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            normalize_images=False,
            optimizer_class=optimizer_class,
            optimizer_kwargs={"fused": True} if optimizer_kwargs is None else optimizer_kwargs,
        )

    @abstractmethod
    def new_actor(self) -> SquashedActor:
        """A fresh actor."""

    @abstractmethod
    def new_critic(self) -> nn.Module:
        """Two fresh critics, both Q-values (B, 1) each from observations and actions."""

    def _build(self, lr_schedule: Schedule) -> None:
        """Create networks and optimisers; what is frozen in the actor gets no optimiser."""
        rate = lr_schedule(1)
        options = dict(self.optimizer_kwargs, lr=rate)
        # They offer what SAC asks of its own actor and critic, without being subclasses of those.
        actor, critic, target = self.new_actor(), *(cast(TwinCritic, self.new_critic()) for _ in range(2))
        actor.optimizer = self.optimizer_class(actor.trainable_parameters(), **options)
        critic.optimizer = self.optimizer_class(critic.parameters(), **options)
        target.load_state_dict(critic.state_dict())
        target.requires_grad_(False)
        target.set_training_mode(False)
        self.actor = cast(sac_policies.Actor, actor)
        self.critic = cast(ContinuousCritic, critic)
        self.critic_target = cast(ContinuousCritic, target)

    def networks(self) -> tuple[Actor, TwinCritic, TwinCritic]:
        """Actor, critics and target critics with their own types."""
        return cast(Actor, self.actor), cast(TwinCritic, self.critic), cast(TwinCritic, self.critic_target)


class ImagePolicy(BasePolicy, ABC):
    """A policy that is shown images, and nothing else."""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Choose actions, as stable-baselines3's ``predict``.

        Args:
            observation: (3, 64, 64) or (B, 3, 64, 64) uint8.
            state: Arrays with a leading B, handed through: nothing is remembered.
            episode_start: (B,) bool; changes nothing.
            deterministic: Without noise.

        Returns:
            Actions (2, R, R) or (B, 2, R, R) float32, and ``state``.

        Raises:
            ValueError: The observation is something else.
        """
        check_images(observation)
        return super().predict(observation, state, episode_start, deterministic)


class CFPPolicy(ImagePolicy, NetworkPolicy):
    """Actor, twin critics and target critics of the coarse-to-fine policy.

    Coarser levels live inside the actor as frozen submodules, so ``state_dict`` and ``predict`` cover the whole
    ladder. The actor reads uint8 images itself (``normalize_images`` is off). ``predict`` does not clip: a composed
    action may leave [-1, 1] by the overshoot of the cubic interpolation, as in the reference implementation.

    Args:
        observation_space: uint8 (3, 64, 64).
        action_space: float32 (2, R, R) in [-1, 1].
        lr_schedule: Learning rate of both optimisers as a function of the remaining progress.
        spec: The actor's ladder; a plain actor of the action space's resolution if None.
        use_sde: Accepted because stable-baselines3 passes it; must be False.
        optimizer_class: Optimiser of actor and critics.
        optimizer_kwargs: Its options except the learning rate; a fused Adam if None.

    Raises:
        ValueError: The size of the spec's actions is not the action space's, or ``use_sde`` is set.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        spec: ActorSpec | None = None,
        use_sde: bool = False,
        optimizer_class: type[torch.optim.Optimizer] = torch.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        """Build the networks and their optimisers."""
        resolution = action_space.shape[-1]
        self.spec = spec or ActorSpec((resolution,))
        size = self.spec.action_size
        if action_space.shape != (2, size, size):
            raise ValueError(
                f"action space: got shape {action_space.shape}, allowed for a ladder {self.spec.resolutions} is "
                f"{(2, size, size)}"
            )
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            use_sde,
            optimizer_class,
            optimizer_kwargs,
        )

    def new_actor(self) -> Actor:
        """The ladder."""
        return build_actor(self.spec)

    def new_critic(self) -> TwinCritic:
        """Critics of the executed action."""
        return TwinCritic(self.spec.action_size, self.spec.split, self.spec.interpolation)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "lr_schedule": self._dummy_schedule,
            "spec": self.spec,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }


class ActorPolicy(ImagePolicy):
    """An actor alone, with stable-baselines3's ``predict``: what `cfp.load` returns.

    Args:
        spec: The actor's ladder.
        deterministic_by_default: How the run that trained it evaluates: SHAPE MATCH without, other tasks with noise.
    """

    action_space: spaces.Box
    deterministic_by_default: bool
    sees_image = True

    def __init__(self, spec: ActorSpec, deterministic_by_default: bool = False) -> None:
        """Build the actor; its weights are random until a state is loaded."""
        space = action_space(spec.action_size)
        super().__init__(observation_space(), space, normalize_images=False, squash_output=True)
        self.spec = spec
        self.deterministic_by_default = deterministic_by_default
        self.description: dict[str, Any] = {}
        self.actor = build_actor(spec).requires_grad_(False)

    @property
    def resolution(self) -> int:
        """Rows and columns of its actions: what the environment must take."""
        return self.spec.action_size

    def forward(self, observation: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Choose actions.

        Args:
            observation: (B, 3, 64, 64) uint8.
            deterministic: Without noise.

        Returns:
            (B, 2, R, R) in [-1, 1].
        """
        action: torch.Tensor = self.actor(observation, deterministic)
        return action

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        return self(cast(torch.Tensor, observation), deterministic)
