"""Actors and critics of the short-horizon actor-critic, and the policy that acts on the state."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from baselines.common.policies import StateBasedPolicy, load_network
from cfp.agent.actor import LATENT, Actor, ActorSpec, Encoder, initialise
from cfp.analytic.critic import mlp
from cfp.analytic.features import StateFeatures
from cfp.policy import Memory, read_policy, report_mismatch, write_policy
from dittogym import TorchEnv
from dittogym.spec import TaskSpec


class StateActor(nn.Module):
    """Mean action before tanh, (B, 2, R, R), from features (B, D)."""

    def __init__(self, inputs: int, resolution: int) -> None:
        super().__init__()
        self.inputs, self.resolution = inputs, resolution
        self.body = mlp(inputs, 2 * resolution**2)

    def forward(self, features: Tensor) -> Tensor:
        """Mean before tanh."""
        output: Tensor = self.body(features)
        return output.unflatten(1, (2, self.resolution, self.resolution))


class ImageActor(nn.Module):
    """The coarsest actor of the coarse-to-fine policy; its mean is trained and its standard deviation fixed."""

    def __init__(self, resolution: int) -> None:
        super().__init__()
        self.spec = ActorSpec((resolution,))
        self.actor = Actor(resolution, self.spec)
        self.actor.fix_std()

    def forward(self, image: Tensor) -> Tensor:
        """Mean before tanh, (B, 2, R, R), of images (B, 3, 64, 64) in [-1, 1]."""
        mean: Tensor = self.actor.mean(self.actor.encoder(image))
        return mean


def image_critic() -> nn.Module:
    """Value (B, 1) of images (B, 3, 64, 64) in [-1, 1], with an encoder like the actor's."""
    return initialise(nn.Sequential(Encoder(3, 32), nn.Flatten(), mlp(LATENT, 1)))


class StatePolicy(StateBasedPolicy):
    """A trained `StateActor`, acting on `StateFeatures` of the environment given to `attached`.

    ``noise`` is the standard deviation before tanh of actions that are not deterministic; ``description`` says what the
    policy is and where it comes from, see `cfp.policy.describe_run`.
    """

    def __init__(
        self, actor: StateActor, features: StateFeatures, noise: float, description: dict[str, Any] | None = None
    ) -> None:
        super().__init__(description)
        self.actor, self.features, self.noise = actor, features, noise

    @property
    def resolution(self) -> int:
        """Action grid R."""
        return self.actor.resolution

    @property
    def num_inputs(self) -> int:
        """Number of features that the network takes."""
        return self.actor.inputs

    def num_features(self, spec: TaskSpec) -> int:
        """Number of features of a task."""
        return self.features.size(len(spec.bodies) - 1)

    def _act(self, env: TorchEnv, state: Memory, deterministic: bool) -> tuple[Tensor, Memory]:
        mean = self.actor(self.features(env).float().to(next(self.actor.parameters()).device))
        if not deterministic:
            mean = mean + self.noise * torch.randn_like(mean)
        return mean.tanh(), state

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``path``, which must end in ``.safetensors``, and a description beside it, which ends in ``.json``."""
        own = {"features": dataclasses.asdict(self.features), "noise": self.noise, "inputs": self.actor.inputs}
        write_policy(path, self.actor.state_dict(), self.description | own)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> StatePolicy:
        """Load what `save` wrote."""
        tensors, description = read_policy(path, device)
        with report_mismatch(path):
            size = description["inputs"], description["resolution"]
            actor = load_network(lambda: StateActor(*size), tensors, device)
            return cls(actor, StateFeatures(**description["features"]), float(description["noise"]), description)
