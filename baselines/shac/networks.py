"""Networks of the short-horizon actor-critic, and the policy that sees the state."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from baselines.shac.features import StateFeatures
from cfp.agent.actor import Actor
from cfp.agent.networks import LATENT, Encoder, initialise
from cfp.agent.spec import ActorSpec
from cfp.weights import fitting, read_policy, write_policy
from dittogym import TorchEnv

WIDTH = 128
"""Units of the hidden layers."""
QUIET = -0.4
"""Output of an image actor's head for the width: a standard deviation of 0.105, near the least it can be."""


def perceptron(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers of 128 units with layer normalisation and ELU; the last layer begins small."""
    layers: list[nn.Module] = []
    for before in (inputs, WIDTH):
        layers += [nn.Linear(before, WIDTH), nn.LayerNorm(WIDTH), nn.ELU()]
    last = nn.Linear(WIDTH, outputs)
    with torch.no_grad():
        last.weight.mul_(0.1)
        last.bias.zero_()
    return nn.Sequential(*layers, last)


class StateActor(nn.Module):
    """Features (B, D) to the mean before tanh, (B, 2, R, R).

    Args:
        inputs: D.
        resolution: R.
    """

    def __init__(self, inputs: int, resolution: int) -> None:
        super().__init__()
        self.inputs, self.resolution = inputs, resolution
        self.body = perceptron(inputs, 2 * resolution**2)

    def forward(self, features: Tensor) -> Tensor:
        """Mean before tanh."""
        output: Tensor = self.body(features)
        return output.unflatten(1, (2, self.resolution, self.resolution))


def quieten(actor: Actor) -> None:
    """Fix the width of an actor of the coarse-to-fine policy at a standard deviation of about 0.1 before tanh."""
    layers = [layer for layer in actor.std.modules() if isinstance(layer, nn.Linear | nn.ConvTranspose2d)]
    nn.init.zeros_(layers[-1].weight)
    assert layers[-1].bias is not None
    nn.init.constant_(layers[-1].bias, QUIET)
    actor.std.requires_grad_(False)


class ImageActor(nn.Module):
    """The first actor of the coarse-to-fine policy, trained through its mean; its width stays about 0.1.

    Args:
        resolution: R.
    """

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.spec = ActorSpec((resolution,))
        self.actor = Actor(resolution)
        quieten(self.actor)

    def forward(self, image: Tensor) -> Tensor:
        """Mean before tanh, (B, 2, R, R), of images (B, 3, 64, 64) in [-1, 1]."""
        mean: Tensor = self.actor.mean(self.actor.encoder(image))
        return mean


def state_critic(inputs: int) -> nn.Module:
    """Value (B, 1) of features (B, D)."""
    return perceptron(inputs, 1)


def image_critic() -> nn.Module:
    """Value (B, 1) of images (B, 3, 64, 64) in [-1, 1], with an encoder like the actor's."""
    return initialise(nn.Sequential(Encoder(3, 32), nn.Flatten(), perceptron(LATENT, 1)))


def shown(env: TorchEnv | None, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[TorchEnv, bool]:
    """The environment that a policy looks at, and whether the observation is a single image.

    Raises:
        RuntimeError: It was not shown an environment.
        ValueError: The images are not as many as the environment has simulations.
    """
    if env is None:
        raise RuntimeError("this policy sees the state of the simulation, not the image: call attached(env) first")
    single = isinstance(observation, np.ndarray) and observation.ndim == 3
    count = 1 if single else len(observation)
    if count != env.num_envs:
        raise ValueError(f"observation: got {count} images, allowed {env.num_envs} as in the environment")
    return env, single


class StatePolicy:
    """Acts on the state of the environment that it is shown by `attached`, not on the image.

    Args:
        actor: The network.
        features: What it is given.
        noise: Standard deviation before tanh of actions that are not deterministic.
        description: What it is and comes from.
        env: Where it looks.
    """

    sees_image = False

    def __init__(
        self,
        actor: StateActor,
        features: StateFeatures,
        noise: float,
        description: dict[str, Any] | None = None,
        env: TorchEnv | None = None,
    ) -> None:
        self.actor, self.features, self.noise, self.env = actor, features, noise, env
        self.description = description or {}

    @property
    def resolution(self) -> int:
        """Action grid R."""
        return self.actor.resolution

    @property
    def deterministic_by_default(self) -> bool:
        """Whether the run that trained it evaluates it without noise."""
        return bool(self.description.get("deterministic", False))

    def attached(self, env: TorchEnv) -> StatePolicy:
        """The same policy, looking at the environment ``env``.

        Raises:
            ValueError: Another task's environment, with other things to see.
        """
        found = self.features.size(len(env.spec.bodies) - 1)
        if found != self.actor.inputs:
            raise ValueError(f"env: got {env.spec.name!r} with {found} features, allowed {self.actor.inputs}")
        return StatePolicy(self.actor, self.features, self.noise, self.description, env)

    @torch.no_grad()
    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions for the state of the attached environment; the image is not looked at.

        Args:
            observation: (B, 3, 64, 64) or (3, 64, 64); only the number of images matters.
            state: Arrays with a leading B, handed through: the policy has no memory.
            episode_start: (B,) bool; changes nothing.
            deterministic: Without noise.

        Returns:
            Actions (B, 2, R, R), or (2, R, R) for one image, and ``state``.

        Raises:
            RuntimeError: It was not shown an environment.
            ValueError: The images are not as many as the environment has simulations.
        """
        env, single = shown(self.env, observation)
        device = next(self.actor.parameters()).device
        mean = self.actor(self.features(env).float().to(device))
        if not deterministic:
            mean = mean + self.noise * torch.randn_like(mean)
        actions = mean.tanh().cpu().numpy()
        return actions[0] if single else actions, state

    def save(self, path: Path) -> None:
        """Write ``path`` (``.safetensors``) and the ``.json`` beside it."""
        own = {"features": dataclasses.asdict(self.features), "noise": self.noise, "inputs": self.actor.inputs}
        write_policy(path, self.actor.state_dict(), self.description | own)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> StatePolicy:
        """Load what `save` wrote.

        Raises:
            CheckpointError: No such file, a damaged one, or one that is not such a policy.
        """
        tensors, description = read_policy(path, device)
        with fitting(path):
            with torch.device("meta"):  # so that a size that the file only claims takes no memory
                actor = StateActor(description["inputs"], description["resolution"])
            actor.load_state_dict(tensors, assign=True)
            features, noise = StateFeatures(**description["features"]), float(description["noise"])
            return cls(actor.to(device, torch.float32).requires_grad_(False), features, noise, description)
