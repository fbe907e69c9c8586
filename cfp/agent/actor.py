"""The actors: a plain one, and one that refines the action of a frozen coarser one (paper, Section 4.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cfp.agent import fused
from cfp.agent.composition import blend, compose
from cfp.agent.lean import LeanEncoder, NetworkInput, Trunk, image_of
from cfp.agent.networks import IMAGE_SIZE, Encoder, PairEncoder, initialise, make_head, normalise_image, upsample
from cfp.agent.spec import ActorSpec

#: Bounds of the standard deviation before tanh; the lower one keeps sampling stochastic.
STD_BOUNDS = (0.1, 6.0)


#: Bias of a standard deviation that is not trained: 0.105 before tanh, near the smallest that is allowed.
STD_BIAS = -0.4


class Outputs(NamedTuple):
    """What an actor's networks make of observations, before noise, tanh and composition.

    Attributes:
        mean: (B, 2, R, R), before tanh.
        raw_std: (B, 2, R, R), see `standard_deviation`.
        gate_logit: (B, 2, R, R) before `ActorSpec.gate_bias`, or None for a plain actor.
        coarse: Sample of the coarser actor, or None for a plain actor.
    """

    mean: Tensor
    raw_std: Tensor
    gate_logit: Tensor | None = None
    coarse: Sample | None = None

    @property
    def location(self) -> Tensor:
        """Mean and gate logit in one tensor, (B, 2, R, R) or (B, 4, R, R): what a deterministic action depends on."""
        return self.mean if self.gate_logit is None else torch.cat([self.mean, self.gate_logit], 1)

    def at(self, location: Tensor) -> Outputs:
        """The same outputs with another `location`."""
        if self.gate_logit is None:
            return self._replace(mean=location)
        mean, gate_logit = location.chunk(2, 1)
        return self._replace(mean=mean, gate_logit=gate_logit)


class Sample(NamedTuple):
    """One sample of an actor."""

    action: Tensor  # to execute, (B, 2, A, A) with A from `ActorSpec.action_size`; may exceed [-1, 1] slightly
    log_prob: Tensor  # log-density of the sampled part, for a residual actor the residual action only, (B,)
    gate: Tensor | None  # weight of the residual action, (B, 2, R, R); None for a plain actor
    parts: tuple[Tensor, ...] = ()  # of the action, see `cfp.agent.composition.Composition`


def squashed_log_prob(noise: Tensor, std: Tensor, action: Tensor) -> Tensor:
    """Log-density (B,) of ``a = tanh(m + s eps)``: ln N(x; m, s^2) - ln(1 - a^2 + 1e-6), summed over all entries."""
    normal = -0.5 * noise.square() - std.log() - 0.5 * math.log(2 * math.pi)
    return (normal - torch.log(1 - action.square() + 1e-6)).flatten(1).sum(1)


def standard_deviation(raw_std: Tensor) -> Tensor:
    """``clip(softplus(3 raw_std - 1), 0.1, 6)``."""
    return F.softplus(3 * raw_std - 1).clamp(*STD_BOUNDS)


def sample_squashed_gaussian(
    mean: Tensor,
    raw_std: Tensor,
    deterministic: bool,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Sample tanh(mean + s eps) with s from `standard_deviation`, and its log-density (B,).

    A ``generator``, if given, belongs to the CPU, whatever the device of the networks.
    """
    std = standard_deviation(raw_std)
    noise = torch.zeros_like(mean)
    if not deterministic:
        noise = noise.normal_() if generator is None else torch.randn(mean.shape, generator=generator).to(mean)
    action = torch.tanh(mean + std * noise)
    return action, squashed_log_prob(noise, std, action)


class SquashedActor(nn.Module):
    """Base class of actors with tanh-squashed Gaussian actions; subclasses implement `sample`."""

    optimizer: torch.optim.Optimizer

    def sample(self, observation: Tensor, deterministic: bool = False) -> Sample:
        """Sample an action for observations (B, ...)."""
        raise NotImplementedError

    def sample_for_critic(self, observation: Tensor, deterministic: bool = False) -> Sample:
        """Sample an action as critics take it; it need not be the executed one."""
        return self.sample(observation, deterministic)

    def trainable_parameters(self) -> list[nn.Parameter]:
        """Parameters to optimise: all but those of frozen coarser stages."""
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    def forward(self, observation: Tensor, deterministic: bool = False) -> Tensor:
        """Action for observations (B, ...)."""
        return self.sample(observation, deterministic).action


class Actor(SquashedActor):
    """Actor of stage 1: a squashed Gaussian over (2, R, R), given the observation."""

    critic_size: int | None = None
    """Size on which actions for critics are blended; None: `ActorSpec.action_size`."""

    def __init__(self, resolution: int, spec: ActorSpec) -> None:
        super().__init__()
        self.resolution = resolution
        lean = spec.encoder == "lean"
        self.encoder: nn.Module = LeanEncoder() if lean else Encoder(3, 32)
        self.trunk = Trunk() if lean else None
        self.mean = make_head(resolution)
        self.std = make_head(resolution)
        initialise(self)

    def outputs(
        self,
        observation: NetworkInput,
        deterministic: bool = False,
        generator: torch.Generator | None = None,
        size: int | None = None,
    ) -> Outputs:
        """Evaluate the networks for uint8 observations (B, 3, 64, 64).

        Args:
            observation: The images; with a lean encoder also `cfp.agent.lean.Encoded`.
            deterministic: Whether a coarser actor acts without noise.
            generator: Of its noise; None for torch's own.
            size: Rows and columns on which coarse and residual actions are blended; None: `ActorSpec.action_size`.
        """
        if self.trunk is None:
            latent = self.encoder(normalise_image(image_of(observation)))
        else:
            latent = self.trunk(self.encoder(observation))
        mean, raw_std = fused.decode([self.mean, self.std], latent)
        return Outputs(mean, raw_std)

    def act(self, outputs: Outputs, deterministic: bool = False, generator: torch.Generator | None = None) -> Sample:
        """Sample an action from the networks' outputs, without noise if ``deterministic``."""
        mean, raw_std = outputs.mean, outputs.raw_std
        action, log_prob = sample_squashed_gaussian(mean, raw_std, deterministic, generator)
        return Sample(action, log_prob, None, (action,))

    def sample(
        self,
        observation: NetworkInput,
        deterministic: bool = False,
        generator: torch.Generator | None = None,
        size: int | None = None,
    ) -> Sample:
        """Sample an action, see `outputs`; a residual actor's ``log_prob`` is its own part's."""
        return self.act(self.outputs(observation, deterministic, generator, size), deterministic, generator)

    def sample_for_critic(self, observation: NetworkInput, deterministic: bool = False) -> Sample:
        """Sample an action that is blended on `ActorSpec.critic_size`."""
        return self.sample(observation, deterministic, size=self.critic_size)

    def fix_std(self) -> None:
        """Set the standard deviation to 0.105 before tanh, and exclude it from training."""
        layers = [layer for layer in self.std.modules() if isinstance(layer, nn.Linear | nn.ConvTranspose2d)]
        nn.init.zeros_(layers[-1].weight)
        assert layers[-1].bias is not None
        nn.init.constant_(layers[-1].bias, STD_BIAS)
        self.std.requires_grad_(False)


class ResidualActor(Actor):
    """Actor of a later stage: refines the action of a frozen coarser actor through a gate (paper, Section 4.2).

    ``a = up(g) up(a_res) + (1 - up(g)) up(a_coarse)`` with ``g = gate_scale sigmoid(z_g + gate_bias)``, one gate value
    per cell and muscle; ``up`` enlarges to `ActorSpec.action_size`, for critics to `ActorSpec.critic_size`. The coarser
    actor is sampled anew in every call, may be residual itself, and is never trained.
    """

    def __init__(self, coarse: Actor, resolution: int, gate_bias: float, spec: ActorSpec) -> None:
        super().__init__(resolution, spec)
        self.interpolation = spec.interpolation
        self.action_size = spec.patch or resolution
        self.critic_size = spec.critic_size if spec.patch else None
        self.gate_bias, self.gate_scale = gate_bias, spec.gate_scale
        if self.trunk is None:
            self.encoder = PairEncoder(spec.split)
        else:
            self.trunk = Trunk(resolution)
        self.gate = make_head(resolution)
        initialise(self.gate)
        self.coarse = coarse.requires_grad_(False)

    def outputs(
        self,
        observation: NetworkInput,
        deterministic: bool = False,
        generator: torch.Generator | None = None,
        size: int | None = None,
    ) -> Outputs:
        """Evaluate the networks; the coarser actor is sampled."""
        image = image_of(observation)
        with torch.no_grad():
            coarse = self.coarse.sample(image, deterministic, generator, size)
            size = size or self.action_size
            coarse = coarse._replace(action=upsample(coarse.action, size, self.interpolation))
        if self.trunk is None:
            patch = upsample(coarse.action, IMAGE_SIZE, self.interpolation)
            latent = self.encoder(normalise_image(image), patch)
        else:
            on_grid = coarse.action
            if size != self.resolution:
                on_grid = compose(coarse.parts, self.resolution, self.interpolation)
            latent = self.trunk(self.encoder(observation), on_grid)
        mean, raw_std, gate_logit = fused.decode([self.mean, self.std, self.gate], latent)
        return Outputs(mean, raw_std, gate_logit, coarse)

    def act(self, outputs: Outputs, deterministic: bool = False, generator: torch.Generator | None = None) -> Sample:
        """Compose an action; ``log_prob`` is that of the residual part alone, as in the reference."""
        mean, raw_std, gate_logit, coarse = outputs
        assert gate_logit is not None and coarse is not None
        residual, log_prob = sample_squashed_gaussian(mean, raw_std, deterministic, generator)
        gate = self.gate_scale * torch.sigmoid(gate_logit + self.gate_bias)
        size = coarse.action.shape[-1]
        large_residual, weight = (upsample(image, size, self.interpolation) for image in (residual, gate))
        action = blend(coarse.action, large_residual, weight)
        return Sample(action, log_prob, gate, (*coarse.parts, residual, gate))


def build_actor(spec: ActorSpec) -> Actor:
    """Build the freshly initialised actor of the last stage, which contains those of all coarser stages."""
    actor = Actor(spec.resolutions[0], spec)
    for resolution, bias in zip(spec.resolutions[1:], spec.gate_bias, strict=True):
        actor = ResidualActor(actor, resolution, bias, spec)
    return actor
