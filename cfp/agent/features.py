"""The encoder of the coarse-to-fine policy as a features extractor for the algorithms of stable-baselines3."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from cfp.agent.actor import IMAGE_SIZE, LATENT, Encoder


class ImageFeatures(BaseFeaturesExtractor):
    """Three convolutions with coordinate channels, for ``policy_kwargs={"features_extractor_class": ImageFeatures}``.

    Args:
        observation_space: uint8 images (3, 64, 64), which stable-baselines3 divides by 255.
        width: Channels of the last layer.

    Raises:
        ValueError: The images have another shape.
    """

    def __init__(self, observation_space: spaces.Box, width: int = 32) -> None:
        shape = (3, IMAGE_SIZE, IMAGE_SIZE)
        if observation_space.shape != shape:
            raise ValueError(f"observation_space must have shape {shape}, got {observation_space.shape}")
        super().__init__(observation_space, LATENT // 32 * width)
        self.encoder = Encoder(3, width)

    def forward(self, observations: Tensor) -> Tensor:
        """Features (B, 16 width) of ``observations`` (B, 3, 64, 64) in [0, 1]."""
        return torch.flatten(self.encoder(2 * observations - 1), 1)
