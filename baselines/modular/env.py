"""A batch of robots seen and moved by segments."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from baselines.modular.kmeans import begin, follow
from baselines.modular.nodes import Nodes, places
from dittogym import TorchEnv
from torchmpm import tree


class SegmentedEnv:
    """Observations are rows of `Nodes`, actions are values of segments; for `cfp.envs.vec_env.TorchVecEnv`.

    A simulation that is no longer finite is seen as it last was; it ends there.

    Args:
        env: With its patch as action grid.
        nodes: How segments are seen and act.
    """

    def __init__(self, env: TorchEnv, nodes: Nodes) -> None:
        self.env, self.nodes = env, nodes
        self.num_envs, self.device, self.action_resolution = env.num_envs, env.device, env.action_resolution
        self._labels: Tensor | None = None
        self._seen = torch.zeros(env.num_envs, nodes.count, nodes.columns(env.spec), device=env.device)

    @property
    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Of observations (K, columns) and actions (K, 2)."""
        shape = tuple(self._seen.shape[1:])
        return spaces.Box(-np.inf, np.inf, shape, np.float32), spaces.Box(-1.0, 1.0, (self.nodes.count, 2), np.float32)

    @property
    def env_state(self) -> tuple[Any, Tensor, Tensor]:
        """State of the simulation, labels (B, N) and what was last seen: all that an episode needs to go on."""
        return self.env.env_state, self.labels, self._seen

    @env_state.setter
    def env_state(self, value: tuple[Any, Tensor, Tensor]) -> None:
        self.env.env_state, self._labels, self._seen = value

    @property
    def generators(self) -> dict[int, dict[str, Tensor]]:
        """See `dittogym.TorchEnv.generators`."""
        return self.env.generators

    @generators.setter
    def generators(self, states: dict[int, dict[str, Tensor]]) -> None:
        self.env.generators = states

    @property
    def labels(self) -> Tensor:
        """Segment (B, N) of every particle of the robot.

        Raises:
            RuntimeError: Before the first reset.
        """
        if self._labels is None:
            raise RuntimeError("call reset() first: there are no segments yet")
        return self._labels

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes, see `dittogym.TorchEnv.reset`; returns rows (B, K, columns) and info."""
        _, info = self.env.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device) if mask is None else mask
        self._labels = segmented(self.env, self.nodes, self._labels, mask)
        return self._look(mask), info

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step, see `dittogym.TorchEnv.step`, with actions (B, K, 2)."""
        field = self.nodes.act(self.env, self.labels, action)
        _, reward, terminated, truncated, info = self.env.step(field)
        labels = follow(places(self.env), self.labels, self.nodes.count)
        self._labels = tree.where(info["finite"], labels, self.labels)
        return self._look(info["finite"]), reward, terminated, truncated, info

    def _look(self, mask: Tensor) -> Tensor:
        self._seen = tree.where(mask, self.nodes(self.env, self.labels), self._seen)
        return self._seen

    def render(self, index: int = 0) -> np.ndarray:
        """Picture of one element."""
        return self.env.render(index)


def segmented(env: TorchEnv, nodes: Nodes, labels: Tensor | None, anew: Tensor) -> Tensor:
    """Labels (B, N) in which the elements of a mask (B,) are segmented anew."""
    x = places(env)
    result = x.new_zeros(x.shape[:2], dtype=torch.int64) if labels is None else labels.clone()
    if bool(anew.any()):
        result[anew] = begin(x[anew], nodes.count)
    return result
