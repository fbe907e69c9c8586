"""The actors of the coarse-to-fine policy (paper, Section 4.2, Appendix B): their structure, networks and actions.

Observations are images (3, 64, 64), actions are images (2, R, R) whose channels drive the x- and the y-muscles. The
actor of stage 1 acts on a coarse grid; that of a later stage refines the action of the frozen coarser one.

There are two sets of networks. Those of the paper give every actor and every critic an encoder of its own. The small
ones share one encoder of half the size between actor and critics, after Yarats et al., "Mastering Visual Continuous
Control" (DrQ-v2, ICLR 2022): the critics alone train it, and actions join its features.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, TypeAlias, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from cfp.agent.pixels import fill_missing
from cfp.errors import ConfigError, check_positive
from dittogym.action import bicubic
from dittogym.geometry import NODES
from dittogym.observation import SIZE

Interpolation = Literal["half_pixel", "aligned"]
EncoderKind = Literal["paper", "small"]

#: Rows and columns of the observation, and of actions as input of the paper's encoders.
IMAGE_SIZE = SIZE
#: Number of entries of a latent image (32, 4, 4).
LATENT = 32 * 4 * 4
#: Channels of the small encoder's features (B, 16, 4, 4), and of those of an action.
SMALL_WIDTH = 16
#: Bounds of the standard deviation before tanh; the lower one keeps sampling stochastic.
STD_BOUNDS = (0.1, 6.0)
#: Bias of a standard deviation that is not trained: 0.105 before tanh, near the smallest that is allowed.
STD_BIAS = -0.4

_DOUBLE, _KEEP = (4, 2, 1), (3, 1, 1)  # (kernel, stride, padding) that double or keep the size
_DECODERS: dict[int, tuple[tuple[tuple[int, int, int], ...], tuple[int, ...]]] = {
    8: ((_DOUBLE, _KEEP, _KEEP), (32, 16, 8, 2)),
    16: ((_DOUBLE, _DOUBLE, _KEEP), (32, 16, 8, 2)),
    32: ((_DOUBLE, _DOUBLE, _DOUBLE), (32, 16, 8, 2)),
    64: ((_DOUBLE, _DOUBLE, _DOUBLE, _DOUBLE), (32, 16, 8, 4, 2)),
}
#: Action grids R for which `make_head` has a decoder.
RESOLUTIONS = (4, *_DECODERS)


@dataclass(frozen=True)
class ActorSpec:
    """Structure of an actor with all of its stages.

    Attributes:
        resolutions: Action grid R of each stage, increasing numbers of 4, 8, 16, 32 and 64. With a single one, the
            actor is a plain actor, that of the first stage; actors of later stages are residual.
        gate_bias: Bias that is added to the gate logit, a number for each residual stage (``len(resolutions) - 1``).
        split: Separate narrow encoders for observation and action, for tasks in which the two images show different
            places; the small networks always have them.
        gate_scale: Largest value of the gate; the reference implementation uses 0.25 with split encoders and 1
            otherwise.
        interpolation: Bicubic upsampling inside the networks: ``"half_pixel"`` as the environment upsamples actions, or
            ``"aligned"`` (aligned corners) as the reference implementation does here.
        patch: Rows and columns of the images on which a residual actor blends coarse and residual actions, which is
            then the size of its actions; from the finest resolution to 128. None blends on the grid of the stage, as
            the reference implementation does. As two cubic upsamplings differ from one, a closed gate leaves the
            coarser force field as it is only if actions are blended at the size of the environment's patch.
        encoder: ``"paper"`` for the paper's networks, or ``"small"`` for networks of half the size and width, in which
            actor and critics share an encoder.
        fill_missing: Fill entries of an image that are 0, as entries that got lost are, by the mean of the 3 x 3
            entries around them, where at least five of these are not 0.

    Raises:
        cfp.ConfigError: A resolution is another number, resolutions do not increase, ``gate_bias`` or ``patch`` does
            not go with them, ``gate_scale`` is not positive, or there is no such encoder or interpolation.
    """

    resolutions: tuple[int, ...]
    gate_bias: tuple[float, ...] = ()
    split: bool = False
    gate_scale: float = 1.0
    interpolation: Interpolation = "half_pixel"
    patch: int | None = None
    encoder: EncoderKind = "paper"
    fill_missing: bool = False

    def __post_init__(self) -> None:
        """Check the fields, also against each other."""
        for name, kind in (("encoder", EncoderKind), ("interpolation", Interpolation)):
            if (value := getattr(self, name)) not in (allowed := get_args(kind)):
                raise ConfigError(f"{name} must be {' or '.join(allowed)}, got {value!r}")
        check_positive(gate_scale=self.gate_scale)
        increasing = list(self.resolutions) == sorted(set(self.resolutions))
        if not self.resolutions or not increasing or not set(self.resolutions) <= set(RESOLUTIONS):
            given = f"{self.resolutions}; by default they follow from the task's coarse and fine"
            raise ConfigError(f"resolutions must be increasing values of {RESOLUTIONS}, got {given}")
        finest, found, count = self.resolutions[-1], len(self.gate_bias), len(self.resolutions) - 1
        if found != count:
            raise ConfigError(f"gate_bias must have {count} values for resolutions {self.resolutions}, got {found}")
        if self.patch is not None and not (isinstance(self.patch, int) and finest <= self.patch <= NODES):
            raise ConfigError(f"patch must be between {finest} (the finest action grid) and {NODES}, got {self.patch}")

    @property
    def action_size(self) -> int:
        """Rows and columns of the actions, the patch of a residual actor or else the finest action grid."""
        return self.patch if self.patch and len(self.resolutions) > 1 else self.resolutions[-1]

    @property
    def critic_size(self) -> int:
        """Rows and columns of actions as critics take them: small critics do not need the enlarged action."""
        return self.resolutions[-1] if self.encoder == "small" else self.action_size

    def filled(self, images: Tensor) -> Tensor:
        """The ``images`` (..., 64, 64) uint8 as networks get them: missing pixels filled if the structure says so."""
        return fill_missing(images) if self.fill_missing else images


# Layers.


def upsample(action: Tensor, size: int, interpolation: Interpolation) -> Tensor:
    """Bicubic interpolation (kernel parameter -0.75) of an action image (B, 2, R, R) to (B, 2, size, size).

    ``"half_pixel"`` is the environment's rule, with which a closed gate reproduces the coarse force field; the
    reference implementation aligns corners here.
    """
    if action.shape[-1] == size:
        return action
    return bicubic(action, size, align_corners=interpolation == "aligned")


def normalise_image(observation: Tensor) -> Tensor:
    """Map uint8 pixels to [-1, 1] by ``s / 255 * 2 - 1``; floating-point images are returned as they are."""
    if observation.is_floating_point():
        return observation
    return _channels_last(observation).float().mul_(2.0 / 255.0).sub_(1.0)


def _channels_last(image: Tensor) -> Tensor:
    """An image with its channels next to each other in memory, in which format convolutions are fastest."""
    return image.contiguous(memory_format=torch.channels_last)


def initialise(module: nn.Module) -> nn.Module:
    """Initialise linear layers Xavier-uniform with zero bias; convolutions keep PyTorch's default.

    Networks are of single precision, as images and rewards are, whatever torch's default is.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    return module.float()


def perceptron(*sizes: int, norm: bool = False) -> nn.Sequential:
    """Linear layers of these sizes on a flattened input, with ELUs between them, and ``norm`` before each ELU."""
    layers: list[nn.Module] = [nn.Flatten()]
    for before, after in pairwise(sizes[:-1]):
        normalisation = [nn.LayerNorm(after, elementwise_affine=False)] if norm else []
        layers += [nn.Linear(before, after), *normalisation, nn.ELU(inplace=True)]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


class Encoder(nn.Module):
    """Three convolutions from (B, C, size, size) to a latent image (B, w, 4, 4), with w, 2w and w channels.

    Two constant channels, (row - 32)/32 and (column - 32)/32 if the size is 64, are appended to the input (the paper's
    "position embedding channel"); they are neither trained nor saved.
    """

    patches: Tensor
    """Coordinate channels in the receptive fields of the first layer, unfolded to (225, 2 kernel^2)."""

    def __init__(self, channels: int, width: int, size: int = IMAGE_SIZE) -> None:
        super().__init__()
        kernel, stride = size // 8, size // 16
        self.first = nn.Conv2d(channels + 2, width, kernel, stride)
        self.rest = nn.Sequential(
            nn.ELU(inplace=True),
            nn.Conv2d(width, 2 * width, 4, stride=2),
            nn.ELU(inplace=True),
            nn.Conv2d(2 * width, width, 3),
            nn.ELU(inplace=True),
        )
        line = (torch.arange(size) - size / 2) / (size / 2)
        grid = torch.stack(torch.meshgrid(line, line, indexing="ij"))
        self.register_buffer("patches", F.unfold(grid[None], kernel, stride=stride)[0].T.contiguous(), persistent=False)

    def forward(self, *images: Tensor) -> Tensor:
        """Encode images (B, c, size, size) with values about [-1, 1], stacked along their channels, to (B, w, 4, 4).

        The first layer is linear in its channels, so that it is evaluated for each image and for the coordinates
        separately: no constants are stacked with the images, and images that need no gradient get none.
        """
        stride = self.first.stride[0]
        *weights, position = self.first.weight.split([*(image.shape[1] for image in images), 2], dim=1)
        coordinates = (self.patches @ position.flatten(1).T + self.first.bias).flatten()
        hidden, *others = (
            (_folded_conv if image.requires_grad else F.conv2d)(_channels_last(image), part, stride=stride)
            for image, part in zip(images, weights, strict=True)
        )
        # Expanded before it is brought to the format of the images: its gradient is then the sum of contiguous rows.
        hidden += coordinates.expand(len(hidden), -1).unflatten(1, (15, 15, -1)).movedim(-1, 1)
        for other in others:
            hidden += other
        latent: Tensor = self.rest(hidden)
        return latent


def _folded_conv(image: Tensor, weight: Tensor, stride: int) -> Tensor:
    """``conv2d`` with a kernel of twice the stride, computed as a 2x2 kernel on blocks of stride x stride pixels.

    On a CPU the gradient with respect to a two-channel image is five times faster, a training with the paper's
    networks by a seventh.
    """
    out, channels = weight.shape[:2]
    tiles = image.movedim(1, -1).unflatten(2, (-1, stride)).unflatten(1, (-1, stride))  # (B, rows, y, columns, x, c)
    kernels = weight.view(out, channels, 2, stride, 2, stride).permute(0, 3, 5, 1, 2, 4)
    return F.conv2d(tiles.transpose(2, 3).flatten(3).movedim(-1, 1), kernels.reshape(out, -1, 2, 2))


class PairEncoder(nn.Module):
    """Encode observation and action together, to a latent of (B, 32, 4, 4).

    With ``split``, two encoders of half the width are used, for tasks in which the images show different places.
    """

    def __init__(self, split: bool) -> None:
        super().__init__()
        widths = ((3, 16), (2, 16)) if split else ((5, 32),)
        self.encoders = nn.ModuleList(Encoder(channels, width) for channels, width in widths)

    def forward(self, image: Tensor, patch: Tensor) -> Tensor:
        """Encode a normalised observation (B, 3, 64, 64) and an upsampled action (B, 2, 64, 64)."""
        if len(self.encoders) == 1:
            latent: Tensor = self.encoders[0](image, patch)
            return latent
        return torch.cat([self.encoders[0](image), self.encoders[1](patch)], dim=1)


def make_head(resolution: int) -> nn.Sequential:
    """Decoder from the latent (B, 32, 4, 4) to an image (B, 2, R, R), without a final activation."""
    if resolution == 4:
        return nn.Sequential(*perceptron(LATENT, 128, 128, 2 * 4 * 4), nn.Unflatten(1, (2, 4, 4)))
    shapes, channels = _DECODERS[resolution]
    layers: list[nn.Module] = []
    for (kernel, stride, padding), (before, after) in zip(shapes, pairwise(channels), strict=True):
        layers += [nn.ConvTranspose2d(before, after, kernel, stride, padding), nn.ELU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def _precise(output: Tensor) -> Tensor:
    """An output in single precision at least, if autocast has reduced it: actions are executed."""
    return output.to(torch.promote_types(output.dtype, torch.float32))


# The small networks.


class Encoded(NamedTuple):
    """Observations that have been encoded already, for networks that share the encoder."""

    image: Tensor  # `halved`, (B, 3, 32, 32)
    features: Tensor  # (B, 16, 4, 4)

    def detach(self) -> Encoded:
        """The same without a gradient to the encoder."""
        return self._replace(features=self.features.detach())


NetworkInput: TypeAlias = Tensor | Encoded


def image_of(observation: NetworkInput) -> Tensor:
    """The images of observations."""
    return observation.image if isinstance(observation, Encoded) else observation


def halved(image: Tensor) -> Tensor:
    """Normalised images (B, 3, 32, 32): means of 2 x 2 pixels of uint8 images; smaller images are done already."""
    if image.shape[-1] < IMAGE_SIZE:
        return image
    pixels = image.short()
    rows = pixels[..., ::2, :] + pixels[..., 1::2, :]
    sums = rows[..., ::2] + rows[..., 1::2]
    return _channels_last(sums).float().mul_(2.0 / (4 * 255.0)).sub_(1.0)


class SmallEncoder(nn.Module):
    """`Encoder` of half the size and width: 2 x 2 pixels are averaged, and features are (B, 16, 4, 4)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = Encoder(3, SMALL_WIDTH, IMAGE_SIZE // 2)

    def forward(self, observation: NetworkInput) -> Tensor:
        """Features of uint8 or `halved` images; those of `Encoded` observations are known."""
        if isinstance(observation, Encoded):
            return observation.features
        features: Tensor = self.layers(halved(observation))
        return features


class ActionEncoder(nn.Module):
    """Features (B, channels, 4, 4) of actions (B, 2, R, R): one layer on each of 4 x 4 tiles of the action grid.

    Larger actions are averaged over the cells of the grid. On the size of the environment's patch hundreds of weights
    would see nearly the same value, and an update of Adam would move their sum by as many steps.
    """

    def __init__(self, resolution: int, channels: int) -> None:
        super().__init__()
        self.resolution, self.side = resolution, resolution // 4
        self.layer = nn.Linear(2 * self.side**2, channels)

    def forward(self, action: Tensor) -> Tensor:
        """Encode actions."""
        if action.shape[-1] != self.resolution:
            action = F.adaptive_avg_pool2d(action, self.resolution)
        tiles = action.unflatten(3, (4, self.side)).unflatten(2, (4, self.side))  # (B, 2, rows, y, columns, x)
        return F.elu(self.layer(tiles.permute(0, 2, 4, 1, 3, 5).flatten(3))).movedim(-1, 1)


class Trunk(nn.Module):
    """The actor's own layer: from the encoder's features, and those of a coarse action, to a latent (B, 32, 4, 4).

    Args:
        resolution: Action grid R of the stage; None for the first stage, which reads no coarse actions.
    """

    def __init__(self, resolution: int | None = None) -> None:
        super().__init__()
        self.action = ActionEncoder(resolution, SMALL_WIDTH) if resolution else None
        channels = LATENT // 16
        self.mix = nn.Conv2d(2 * SMALL_WIDTH if resolution else SMALL_WIDTH, channels, 3, padding=1)
        self.norm = nn.GroupNorm(1, channels)

    def forward(self, features: Tensor, coarse: Tensor | None = None) -> Tensor:
        """The latent for features (B, 16, 4, 4) and coarse actions (B, 2, R, R)."""
        if self.action is not None:
            assert coarse is not None
            features = torch.cat([features, self.action(coarse)], dim=1)
        return F.elu(self.norm(self.mix(features)))


# Actions: their distribution, and how those of the stages are composed.


class Outputs(NamedTuple):
    """What an actor's networks make of observations, before noise, tanh and composition."""

    mean: Tensor  # (B, 2, R, R), before tanh
    raw_std: Tensor  # (B, 2, R, R), see `standard_deviation`
    gate_logit: Tensor | None = None  # (B, 2, R, R) before `ActorSpec.gate_bias`; None for a plain actor
    coarse: Sample | None = None  # of the coarser actor; None for a plain actor

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
    parts: tuple[Tensor, ...] = ()  # of the action, see `compose`


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

    A ``generator``, if given, may belong to the CPU, whatever the device of the networks.
    """
    std = standard_deviation(raw_std)
    if deterministic:
        noise = torch.zeros_like(mean)
    elif generator is None:
        noise = torch.randn_like(mean)
    else:
        noise = torch.randn(mean.shape, generator=generator, device=generator.device).to(mean)
    action = torch.tanh(mean + std * noise)
    return action, squashed_log_prob(noise, std, action)


def blend(coarse: Tensor, residual: Tensor, gate: Tensor) -> Tensor:
    """``g a_res + (1 - g) a_coarse``, of actions and gates that are upsampled already (paper, Section 4.2)."""
    return gate * residual + (1 - gate) * coarse


def compose(parts: Sequence[Tensor], size: int, interpolation: Interpolation) -> Tensor:
    """Actions (B, 2, size, size) from their parts: the action of the first stage, then residual and gate of each."""
    action, *rest = (upsample(part, size, interpolation) for part in parts)
    for residual, gate in zip(rest[::2], rest[1::2], strict=True):
        action = blend(action, residual, gate)
    return action


# The actors.


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
        small = spec.encoder == "small"
        self.encoder: nn.Module = SmallEncoder() if small else Encoder(3, 32)
        self.trunk = Trunk() if small else None
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
            observation: The images; with the small networks also `Encoded`.
            deterministic: Whether a coarser actor acts without noise.
            generator: Of its noise; None for torch's own.
            size: Rows and columns on which coarse and residual actions are blended; None: `ActorSpec.action_size`.
        """
        if self.trunk is None:
            latent = self.encoder(normalise_image(image_of(observation)))
        else:
            latent = self.trunk(self.encoder(observation))
        mean, raw_std = (_precise(head(latent)) for head in (self.mean, self.std))
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
        mean, raw_std, gate_logit = (_precise(head(latent)) for head in (self.mean, self.std, self.gate))
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
    return actor.float()
