"""An environment whose observations and actions are those of the robot's segments."""

from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from baselines.modular.kmeans import fit, update
from baselines.modular.nodes import Nodes, visible_positions
from dittogym import TorchEnv
from dittogym.action import from_grid_layout
from dittogym.spec import TaskSpec
from torchmpm import tree


class SegmentedState(NamedTuple):
    """All that the episodes of a `SegmentedEnv` need to continue."""

    simulation: Any
    labels: Tensor  # (B, N)
    observation: Tensor  # the last one, (B, K, columns)

    @property
    def steps(self) -> Tensor:
        """Control steps of the episodes (B,)."""
        steps: Tensor = self.simulation.steps
        return steps


class SegmentedEnv:
    """Observes rows of `Nodes` and takes actions of segments; for `cfp.envs.vec_env.TorchVecEnv`.

    A simulation that is not finite keeps its last observation; its episode ends there. ``labels`` (B, N) are the
    segments of the robot's particles.
    """

    def __init__(self, env: TorchEnv, nodes: Nodes) -> None:
        self.env, self.nodes = env, nodes
        self.num_envs, self.device = env.num_envs, env.device
        self.labels = torch.zeros(env.num_envs, env.model.num_robot_particles, dtype=torch.int64, device=env.device)
        self._observation = torch.zeros(env.num_envs, nodes.count, nodes.num_columns(env.spec), device=env.device)

    @property
    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Spaces of observations (K, columns) and actions (K, 2)."""
        shape = tuple(self._observation.shape[1:])
        return spaces.Box(-np.inf, np.inf, shape, np.float32), spaces.Box(-1.0, 1.0, (self.nodes.count, 2), np.float32)

    @property
    def spec(self) -> TaskSpec:
        """The task."""
        return self.env.spec

    @property
    def env_state(self) -> SegmentedState:
        """State of the simulation, labels and last observation."""
        return SegmentedState(self.env.env_state, self.labels, self._observation)

    @env_state.setter
    def env_state(self, value: SegmentedState) -> None:
        self.env.env_state, self.labels, self._observation = value

    @property
    def generators(self) -> dict[int, dict[str, Tensor]]:
        """See `dittogym.TorchEnv.generators`."""
        return self.env.generators

    @generators.setter
    def generators(self, states: dict[int, dict[str, Tensor]]) -> None:
        self.env.generators = states

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes, see `dittogym.TorchEnv.reset`; returns rows (B, K, columns) and info."""
        _, info = self.env.reset(seed=seed, options=options)
        mask = (options or {}).get("reset_mask")
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device) if mask is None else mask
        self.labels = segment(visible_positions(self.env), self.labels, self.nodes.count, mask)
        return self._observe(mask), info

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Advance by one control step, see `dittogym.TorchEnv.step`, with actions (B, K, 2)."""
        field = self.nodes.to_grid(self.env, self.labels, action)
        _, reward, terminated, truncated, info = self.env.step(from_grid_layout(field, self.env.action_layout))
        labels = update(visible_positions(self.env), self.labels, self.nodes.count)
        self.labels = tree.where(info["finite"], labels, self.labels)
        return self._observe(info["finite"]), reward, terminated, truncated, info

    def _observe(self, mask: Tensor) -> Tensor:
        self._observation = tree.where(mask, self.nodes.observe(self.env, self.labels), self._observation)
        return self._observation


def segment(x: Tensor, labels: Tensor, count: int, mask: Tensor) -> Tensor:
    """Labels (B, N) in which the elements of a mask (B,), with particles at x (B, N, 2), are segmented anew."""
    labels = labels.clone()
    if bool(mask.any()):
        labels[mask] = fit(x[mask], count)
    return labels
