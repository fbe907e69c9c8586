"""The architecture of an actor as plain data, from which its networks are built before their weights are loaded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cfp.errors import ConfigError
from dittogym.geometry import NODES

Interpolation = Literal["half_pixel", "aligned"]
EncoderKind = Literal["full", "lean"]

#: Action grids R for which ``cfp.agent.networks.make_head`` has a decoder.
RESOLUTIONS = (4, 8, 16, 32, 64)


@dataclass(frozen=True)
class ActorSpec:
    """Structure of an actor with all of its stages.

    Attributes:
        resolutions: Action grid R of each stage, coarsest first; a single entry describes a plain (stage 1) actor.
        gate_bias: Bias added to the gate logit, one for each residual stage (``len(resolutions) - 1`` values).
        split: Separate narrow encoders for observation and action, for tasks in which the two images show different
            places.
        gate_scale: Largest gate value; the reference implementation uses 0.25 with split encoders and 1 otherwise.
        interpolation: Bicubic upsampling inside the networks: ``"half_pixel"`` as the environment upsamples actions,
            ``"aligned"`` (aligned corners) as the reference implementation does here.
        patch: Size of the images on which a residual actor blends coarse and residual actions; None blends on the
            grid of the stage, as the reference does. Two cubic upsamplings differ from one, so a closed gate leaves
            the coarser force field only if actions are blended at the size of the environment's patch.
        encoder: ``"full"`` for the paper's, ``"lean"`` for `cfp.agent.lean.LeanEncoder`.

    Raises:
        ConfigError: A resolution has no decoder, resolutions do not increase, or ``gate_bias`` or ``patch`` do not
            match them.
    """

    resolutions: tuple[int, ...]
    gate_bias: tuple[float, ...] = ()
    split: bool = False
    gate_scale: float = 1.0
    interpolation: Interpolation = "half_pixel"
    patch: int | None = None
    encoder: EncoderKind = "full"

    @property
    def action_size(self) -> int:
        """Rows and columns of the executed action: the patch of a residual actor, else the finest action grid."""
        return self.patch if self.patch and len(self.resolutions) > 1 else self.resolutions[-1]

    @property
    def critic_size(self) -> int:
        """Rows and columns of actions as critics take them: lean ones do not need the enlarged action."""
        return self.resolutions[-1] if self.encoder == "lean" else self.action_size

    def __post_init__(self) -> None:
        """Check that the fields match each other."""
        increasing = list(self.resolutions) == sorted(set(self.resolutions))
        if not self.resolutions or not increasing or not set(self.resolutions) <= set(RESOLUTIONS):
            given = f"{self.resolutions}; by default they follow from the task's coarse and fine"
            raise ConfigError(f"resolutions must be increasing values of {RESOLUTIONS}, got {given}")
        finest, found, count = self.resolutions[-1], len(self.gate_bias), len(self.resolutions) - 1
        if found != count:
            raise ConfigError(f"gate_bias must have {count} values for resolutions {self.resolutions}, got {found}")
        if self.patch is not None and not (isinstance(self.patch, int) and finest <= self.patch <= NODES):
            raise ConfigError(f"patch must be between {finest} (the finest action grid) and {NODES}, got {self.patch}")
