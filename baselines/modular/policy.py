"""The policy that a modular actor is once it is trained."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.common.policies import StateBasedPolicy, load_network
from baselines.modular.env import segment
from baselines.modular.kmeans import fit, update
from baselines.modular.networks import ModularActor
from baselines.modular.nodes import Nodes, visible_positions
from cfp.weights import read_policy, report_mismatch, write_policy
from dittogym import TorchEnv
from dittogym.spec import TaskSpec


class SegmentPolicy(StateBasedPolicy):
    """Acts on the segments of the robots in the environment given to `attached`, not on the image.

    Its memory is the segmentation: pass the second result of `predict` back as ``state``, or robots are segmented anew
    in every step.

    Args:
        actor: The network.
        nodes: Features and actions of segments.
        description: What it is and where it comes from, see `cfp.weights.describe_run`.
    """

    change: Callable[[np.ndarray], np.ndarray] | None = None

    def __init__(self, actor: ModularActor, nodes: Nodes, description: dict[str, Any] | None = None) -> None:
        super().__init__(description)
        self.actor, self.nodes = actor, nodes

    @property
    def resolution(self) -> int:
        """Action grid R of the environment that it acts in."""
        return int(self.description["resolution"])

    @property
    def num_inputs(self) -> int:
        """Number of features of a node that the network takes."""
        return self.actor.trunk.features

    def num_features(self, spec: TaskSpec) -> int:
        """Number of features of a node in a task."""
        return self.nodes.num_features(spec)

    def through(self, change: Callable[[np.ndarray], np.ndarray]) -> SegmentPolicy:
        """Return the same policy, with ``change`` applied to its decisions (B, K, 2) before they reach the grid."""
        policy = copy.copy(self)
        policy.change = change
        return policy

    def _act(
        self, env: TorchEnv, state: tuple[np.ndarray, ...] | None, deterministic: bool
    ) -> tuple[Tensor, tuple[np.ndarray, ...] | None]:
        """Actions (B, 2, P, P), and the segment of every particle, (B, N)."""
        x, count = visible_positions(env), self.nodes.count
        if state is None:
            labels = fit(x, count)
        else:
            labels = update(x, torch.as_tensor(state[0], device=env.device), count)
            labels = segment(x, labels, count, env.env_state.steps == 0)
        device = next(self.actor.parameters()).device
        values = self.actor(self.nodes.observe(env, labels).to(device), deterministic)
        if self.change is not None:
            values = torch.from_numpy(self.change(values.cpu().numpy()))
        return self.nodes.to_grid(env, labels, values.to(env.device)), (labels.cpu().numpy(),)

    def save(self, path: Path) -> None:
        """Write ``path`` (``.safetensors``) and the ``.json`` beside it."""
        trunk = self.actor.trunk
        own = {"nodes": dataclasses.asdict(self.nodes), "network": {"kind": trunk.kind, "features": trunk.features}}
        write_policy(path, self.actor.state_dict(), self.description | own)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> SegmentPolicy:
        """Load what `save` wrote.

        Raises:
            CheckpointError: The file is missing, damaged, or not such a policy.
        """
        tensors, description = read_policy(path, device)
        with report_mismatch(path):
            actor = load_network(lambda: ModularActor(**description["network"]), tensors, device)
            return cls(actor, Nodes(**description["nodes"]), description)
