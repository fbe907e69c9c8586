"""The encoder of the coarse-to-fine policy for stable-baselines3's own algorithms."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from cfp.agent.networks import IMAGE_SIZE, LATENT, Encoder


class ImageFeatures(BaseFeaturesExtractor):
    """Three convolutions with coordinate channels, for ``policy_kwargs={"features_extractor_class": ImageFeatures}``.

    Args:
        observation_space: Images (3, 64, 64), uint8; stable-baselines3 hands them on divided by 255.
        width: Channels of the last layer.

    Raises:
        ValueError: Images of another shape.
    """

    def __init__(self, observation_space: spaces.Box, width: int = 32) -> None:
        shape = (3, IMAGE_SIZE, IMAGE_SIZE)
        if observation_space.shape != shape:
            raise ValueError(f"observation_space: got shape {observation_space.shape}, allowed {shape}")
        super().__init__(observation_space, LATENT // 32 * width)
        self.encoder = Encoder(3, width)

    def forward(self, observations: Tensor) -> Tensor:
        """Features (B, 16 width) of ``observations`` (B, 3, 64, 64) in [0, 1]."""
        return torch.flatten(self.encoder(2 * observations - 1), 1)
