"""The actors: a plain one, and one that refines a frozen coarser one (paper, Section 4.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cfp.agent import fused as joint
from cfp.agent.composition import blend
from cfp.agent.networks import (
    IMAGE_SIZE,
    Encoder,
    PairEncoder,
    at_least_float32,
    initialise,
    make_head,
    normalise_image,
    upsample,
)
from cfp.agent.spec import ActorSpec

STD_BOUNDS = (0.1, 6.0)
"""Bounds of the standard deviation before tanh: sampling never becomes deterministic."""


class Sample(NamedTuple):
    """One draw from an actor.

    Attributes:
        action: What is executed, (B, 2, A, A) with A from `ActorSpec.action_size`. A composed action may leave [-1, 1]
            a little and is not clipped.
        log_prob: Log-density of the sampled part (a residual actor's own action only), (B,).
        gate: Weight of the residual action, (B, 2, R, R), or None for a plain actor.
        parts: What the action is made of, see `cfp.agent.composition.Composition`.
    """

    action: Tensor
    log_prob: Tensor
    gate: Tensor | None
    parts: tuple[Tensor, ...] = ()


def squashed_log_prob(noise: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """Log-density (B,) of ``action = tanh(mean + std * noise)`` summed over all 2 R R entries.

    ln N(x; m, s^2) - ln(1 - a^2 + 1e-6), where (x - m)/s is the noise itself.
    """
    normal = -0.5 * noise.square() - std.log() - 0.5 * math.log(2 * math.pi)
    return (normal - torch.log(1 - action.square() + 1e-6)).flatten(1).sum(1)


def draw(mean: Tensor, width: Tensor, deterministic: bool) -> tuple[Tensor, Tensor]:
    """Draw tanh(m + s eps), the tanh-Gaussian of all actors; deterministic means eps = 0.

    Args:
        mean: Network output z_m, (B, ...); the mean m before tanh.
        width: Network output z_s, the same shape; s = clip(softplus(3 z_s - 1), 0.1, 6).
        deterministic: Without noise.

    Returns:
        The action, the same shape, and its log-density (B,).
    """
    std = F.softplus(3 * width - 1).clamp(*STD_BOUNDS)
    noise = torch.zeros_like(mean) if deterministic else torch.randn_like(mean)
    action = torch.tanh(mean + std * noise)
    return action, squashed_log_prob(noise, std, action)


class SquashedActor(nn.Module):
    """What soft actor-critic asks of an actor; a subclass says how it draws."""

    optimizer: torch.optim.Optimizer

    def sample(self, observation: Tensor, deterministic: bool = False) -> Sample:
        """Draw an action for observations with leading B."""
        raise NotImplementedError

    def trainable_parameters(self) -> list[nn.Parameter]:
        """Parameters that an optimiser may change: all but those of frozen coarser levels."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def forward(self, observation: Tensor, deterministic: bool = False) -> Tensor:
        """The action for observations with leading B."""
        return self.sample(observation, deterministic).action

    def action_log_prob(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Flat actions and log-densities (B,): what stable-baselines3's own SAC asks of an actor."""
        sample = self.sample(observation)
        return sample.action.flatten(1), sample.log_prob

    def set_training_mode(self, mode: bool) -> None:
        """Switch between training and evaluation; without effect on these layers, asked for by stable-baselines3."""
        self.train(mode)


class Actor(SquashedActor):
    """Stage-1 actor: a tanh-Gaussian over (2, R, R), from the observation alone; see `draw`."""

    def __init__(self, resolution: int) -> None:
        """Create encoder (width 32 in every task) and the heads for mean and std."""
        super().__init__()
        self.resolution = resolution
        self.encoder: nn.Module = Encoder(3, 32)
        self.mean = make_head(resolution)
        self.std = make_head(resolution)
        initialise(self)

    def own_action(self, latent: Tensor, deterministic: bool, *heads: nn.Sequential) -> tuple[Tensor, ...]:
        """Draw tanh(m + s eps) from a latent (B, 32, 4, 4); deterministic means eps = 0.

        Returns:
            The action, its log-density, and what further heads give for the latent.
        """
        mean, width, *others = map(at_least_float32, joint.decode([self.mean, self.std, *heads], latent))
        return *draw(mean, width, deterministic), *others

    def sample(self, observation: Tensor, deterministic: bool = False) -> Sample:
        """Draw an action for uint8 observations (B, 3, 64, 64)."""
        latent = self.encoder(normalise_image(observation))
        action, log_prob = self.own_action(latent, deterministic)
        return Sample(action, log_prob, None, (action,))


class ResidualActor(Actor):
    """Stage-2 actor: refines the action of a frozen coarser actor through a gate (paper, Section 4.2).

    ``a = up(g) * up(a_res) + (1 - up(g)) * up(a_coarse)`` with ``g = gate_scale * sigmoid(z_g + gate_bias)``, one gate
    value per cell and muscle; ``up`` enlarges to `ActorSpec.action_size`. The coarser actor is drawn anew at every
    call, may itself be residual, and is never trained.
    """

    def __init__(self, coarse: Actor, resolution: int, gate_bias: float, spec: ActorSpec) -> None:
        """Wrap and freeze ``coarse``; the spec says how images are merged and interpolated."""
        super().__init__(resolution)
        self.interpolation = spec.interpolation
        self.action_size = spec.patch or resolution
        self.gate_bias, self.gate_scale = gate_bias, spec.gate_scale
        self.encoder = PairEncoder(spec.split)
        self.gate = make_head(resolution)
        initialise(self.gate)
        self.coarse = coarse.requires_grad_(False)

    def sample(self, observation: Tensor, deterministic: bool = False) -> Sample:
        """Draw a composed action; log_prob belongs to the residual part alone, as in the reference."""
        with torch.no_grad():
            below = self.coarse.sample(observation, deterministic)
            coarse = self._enlarge(below.action)
        patch = upsample(coarse, IMAGE_SIZE, self.interpolation)
        latent = self.encoder(normalise_image(observation), patch)
        residual, log_prob, logit = self.own_action(latent, deterministic, self.gate)
        gate = self.gate_scale * torch.sigmoid(logit + self.gate_bias)
        action = blend(coarse, residual, gate, self._enlarge)
        return Sample(action, log_prob, gate, (*below.parts, residual, gate))

    def _enlarge(self, image: Tensor) -> Tensor:
        return upsample(image, self.action_size, self.interpolation)


def build_actor(spec: ActorSpec) -> Actor:
    """Build the actor of the finest level with all coarser ones inside it, freshly initialised."""
    actor = Actor(spec.resolutions[0])
    for resolution, bias in zip(spec.resolutions[1:], spec.gate_bias, strict=True):
        actor = ResidualActor(actor, resolution, bias, spec)
    return actor
