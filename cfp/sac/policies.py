"""The networks as a policy of stable-baselines3: actor, twin critics and target critics, and the critics themselves."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac import policies as sac_policies
from torch import Tensor, nn

from cfp.agent.actor import (
    IMAGE_SIZE,
    LATENT,
    SMALL_WIDTH,
    ActionEncoder,
    Actor,
    ActorSpec,
    Encoded,
    Interpolation,
    NetworkInput,
    PairEncoder,
    SquashedActor,
    build_actor,
    halved,
    initialise,
    normalise_image,
    perceptron,
    upsample,
)
from cfp.policy import check_images


class PaperCritic(nn.Module):
    """An action-value network: an encoder of its own and a 512-256-256-1 perceptron."""

    def __init__(self, split: bool) -> None:
        super().__init__()
        self.encoder = PairEncoder(split)
        self.value = perceptron(LATENT, 256, 256, 1)
        initialise(self)

    def forward(self, image: Tensor, patch: Tensor) -> Tensor:
        """Values (B, 1) of normalised images (B, 3, 64, 64) and upsampled actions (B, 2, 64, 64)."""
        value: Tensor = self.value(self.encoder(image, patch))
        return value


class TwinCritic(nn.Module):
    """Two critics of actions (2, R, R) that share no parameters with each other or with the actor."""

    optimizer: torch.optim.Optimizer

    def __init__(self, resolution: int, split: bool, interpolation: Interpolation) -> None:
        super().__init__()
        self.resolution, self.interpolation = resolution, interpolation
        self.critics = nn.ModuleList(PaperCritic(split) for _ in range(2))

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        """Values (B, 1) of both critics for images (B, 3, 64, 64) and actions (B, 2, R, R) or (B, 2 R R)."""
        image = normalise_image(observation)
        patch = upsample(action.reshape(-1, 2, self.resolution, self.resolution), IMAGE_SIZE, self.interpolation)
        return tuple(critic(image, patch) for critic in self.critics)


class SmallCritics(nn.Module):
    """Two critics of actions (2, R, R) on the features of the encoder that they share with the actor.

    Layers are normalised, which bounds the values of actions that were never tried (Ball et al., "Efficient Online
    Reinforcement Learning with Offline Data", ICML 2023).

    Args:
        resolution: Action grid R of the actor.
    """

    optimizer: torch.optim.Optimizer

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.actions = ActionEncoder(resolution, 2 * SMALL_WIDTH)  # half of the channels for each critic
        self.heads = nn.ModuleList(perceptron(LATENT, 256, 256, 1, norm=True) for _ in range(2))
        initialise(self)

    def forward(self, observation: Encoded, action: Tensor) -> tuple[Tensor, ...]:
        """Values (B, 1) of both critics for encoded observations and actions (B, 2, R, R) or (B, 2 R R), or larger."""
        size = math.isqrt(action[0].numel() // 2)
        features = self.actions(action.reshape(-1, 2, size, size))
        latents = (torch.cat([observation.features, part], dim=1) for part in features.chunk(2, dim=1))
        return tuple(head(latent) for head, latent in zip(self.heads, latents, strict=True))


class TwinCriticPolicy(sac_policies.SACPolicy, ABC):
    """Base class of the policies that `cfp.CFP` trains; subclasses create actor and critics.

    Networks read observations as they are. ``use_sde`` must be False; the optimiser is a fused Adam by default.
    """

    def __init__(self, *spaces_and_schedule: Any, use_sde: bool = False, **options: Any) -> None:
        if use_sde:
            raise ValueError("use_sde must be False, got True: the actor has its own exploration noise")
        options.setdefault("optimizer_kwargs", {"fused": True})
        options["normalize_images"] = False
        super().__init__(*spaces_and_schedule, **options)

    @abstractmethod
    def new_actor(self) -> SquashedActor:
        """Create an actor."""

    @abstractmethod
    def new_critic(self) -> nn.Module:
        """Create twin critics: a module that returns two values (B, 1) for observations and actions."""

    def shared_encoder(self) -> nn.Module | None:
        """A part of the actor that the critics read too, and train."""
        return None

    def encode(self, observations: Tensor) -> NetworkInput:
        """What actor and critics take for ``observations`` (B, ...) in an update."""
        return normalise_image(observations)

    def _build(self, lr_schedule: Schedule) -> None:
        """Create networks and optimisers; frozen parameters of the actor are not optimised."""
        options = dict(self.optimizer_kwargs, lr=lr_schedule(1))
        # They have the interface that SAC uses, without being subclasses of its own actor and critic.
        actor, critic, target = self.new_actor(), *(cast(TwinCritic, self.new_critic()) for _ in range(2))
        self.actor = cast(sac_policies.Actor, actor)
        encoder = self.shared_encoder()
        shared = [] if encoder is None else list(encoder.parameters())
        own = [parameter for parameter in actor.trainable_parameters() if all(parameter is not each for each in shared)]
        actor.optimizer = self.optimizer_class(own, **options)
        critic.optimizer = self.optimizer_class([*critic.parameters(), *shared], **options)
        target.load_state_dict(critic.state_dict())
        target.requires_grad_(False)
        target.eval()
        self.critic = cast(ContinuousCritic, critic)
        self.critic_target = cast(ContinuousCritic, target)

    def set_training_mode(self, mode: bool) -> None:
        """Switch actor and critics between training and evaluation."""
        self.actor.train(mode)
        self.critic.train(mode)
        self.training = mode

    def networks(self) -> tuple[Actor, TwinCritic, TwinCritic]:
        """Actor, critics and target critics with their own types."""
        return cast(Actor, self.actor), cast(TwinCritic, self.critic), cast(TwinCritic, self.critic_target)


class CFPPolicy(TwinCriticPolicy):
    """Actor, twin critics and target critics of the coarse-to-fine policy.

    The actors of coarser stages are frozen submodules of the actor, so ``state_dict`` and ``predict`` cover all stages.
    ``predict`` does not clip: a composed action may exceed [-1, 1] by the overshoot of the cubic interpolation.

    Args:
        observation_space: A ``Box`` of uint8 images (3, 64, 64).
        action_space: A ``Box`` of float32 actions (2, R, R) in [-1, 1].
        lr_schedule: Learning rate as a function of the remaining share of the training, from 1 to 0.
        spec: Structure of the actor; None for a plain actor of the resolution of the action space.
        options: Further arguments of stable-baselines3's ``SACPolicy``, such as ``optimizer_class`` and
            ``optimizer_kwargs``; the default is a fused Adam.

    Raises:
        ValueError: The actions of ``spec`` do not have the shape of the action space, or ``use_sde=True`` is given.
        cfp.ConfigError: There are no networks for actions of this shape, see `cfp.ActorSpec`.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        lr_schedule: Schedule,
        spec: ActorSpec | None = None,
        **options: Any,
    ) -> None:
        self.spec = spec or ActorSpec((action_space.shape[-1],))
        size = self.spec.action_size
        if (found := action_space.shape) != (2, size, size):
            grids = self.spec.resolutions
            raise ValueError(f"action_space must have shape {(2, size, size)} for resolutions {grids}, got {found}")
        super().__init__(observation_space, action_space, lr_schedule, **options)

    def new_actor(self) -> Actor:
        """Create the actor with those of all coarser stages."""
        return build_actor(self.spec)

    def new_critic(self) -> TwinCritic | SmallCritics:
        """Create critics of actions as the actor's ``sample_for_critic`` composes them."""
        spec = self.spec
        if spec.encoder == "small":
            return SmallCritics(spec.critic_size)
        return TwinCritic(spec.action_size, spec.split, spec.interpolation)

    def shared_encoder(self) -> nn.Module | None:
        """The small encoder, which actor and critics share."""
        return cast(Actor, self.actor).encoder if self.spec.encoder == "small" else None

    def encode(self, observations: Tensor) -> NetworkInput:
        """What actor and critics take for ``observations`` (B, 3, 64, 64): with the small networks its features too."""
        encoder = self.shared_encoder()
        if encoder is None:
            return super().encode(observations)
        image = halved(observations)
        return Encoded(image, encoder(image))

    def obs_to_tensor(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """The ``observation``, uint8 (3, 64, 64) or (B, 3, 64, 64), as a batch (B, 3, 64, 64), and if it was one."""
        check_images(observation)
        images, batched = super().obs_to_tensor(observation)
        return self.spec.filled(cast(Tensor, images)), batched

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ("observation_space", "action_space", "spec", "optimizer_class", "optimizer_kwargs")
        return {name: getattr(self, name) for name in names} | {"lr_schedule": self._dummy_schedule}
