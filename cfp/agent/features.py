"""The encoder of the coarse-to-fine policy as a features extractor for the algorithms of stable-baselines3."""

from __future__ import annotations

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor

from cfp.agent.actor import IMAGE_SIZE, LATENT, Encoder


class ImageFeatures(BaseFeaturesExtractor):
    """The image encoder of the coarse-to-fine policy as a features extractor for stable-baselines3.

    It consists of three convolutions on the image and two coordinate channels, and returns ``16 * width`` features. Use
    it with ``policy_kwargs={"features_extractor_class": cfp.ImageFeatures}``.

    Args:
        observation_space: A ``Box`` of uint8 images (3, 64, 64), which stable-baselines3 divides by 255.
        width: Channels of the last layer.

    Raises:
        ValueError: The images have another shape.

    Examples:
        >>> import cfp, gymnasium, stable_baselines3
        >>> env = gymnasium.make("dittogym/run-coarse-v0", particles="lite")
        >>> options = {"features_extractor_class": cfp.ImageFeatures}
        >>> model = stable_baselines3.PPO("CnnPolicy", env, policy_kwargs=options, device="cpu")
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
