"""Actor and critics with weights shared by all segments, graph networks or Transformers, and the policy they make."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from baselines.common.policies import StateBasedPolicy, load_network
from baselines.modular.segments import Nodes, fit, segment, unpack, update, visible_positions
from cfp.agent.actor import Sample, SquashedActor, initialise, perceptron, sample_squashed_gaussian
from cfp.policy import Memory, read_policy, report_mismatch, write_policy
from dittogym import TorchEnv
from dittogym.action import from_grid_layout, trained_layout
from dittogym.spec import TaskSpec

Kind = Literal["gnn", "transformer"]
#: Width of the hidden layers.
WIDTH = 128
#: Rounds of messages, or layers of attention.
LAYERS = 3
#: Attention heads.
HEADS = 4


class GraphTrunk(nn.Module):
    """Three rounds of messages between neighbours, with shared weights (after Pathak et al., NeurIPS 2019)."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.embed = nn.Sequential(nn.Linear(inputs, WIDTH), nn.ELU(), nn.Linear(WIDTH, WIDTH), nn.ELU())
        self.own, self.message = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)

    def forward(self, nodes: Tensor, edges: Tensor) -> Tensor:
        """Hidden states (B, K, 128) of nodes (B, K, inputs) with edges (B, K, K), 0 or 1."""
        weights = edges / edges.sum(-1, keepdim=True).clamp_min(1.0)
        hidden: Tensor = self.embed(nodes)
        for _ in range(LAYERS):
            hidden = hidden + F.elu(self.own(hidden) + self.message(weights @ hidden))
        return hidden


class AttentionTrunk(nn.Module):
    """Three layers of self-attention over all nodes, pre-norm, without positional encoding."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.embed = nn.Linear(inputs, WIDTH)
        layer = nn.TransformerEncoderLayer(WIDTH, HEADS, 2 * WIDTH, dropout=0.0, batch_first=True, norm_first=True)
        self.layers = nn.TransformerEncoder(layer, LAYERS, nn.LayerNorm(WIDTH), enable_nested_tensor=False)

    def forward(self, nodes: Tensor, edges: Tensor | None) -> Tensor:
        """Hidden states (B, K, 128) of nodes (B, K, inputs)."""
        hidden: Tensor = self.layers(self.embed(nodes))
        return hidden


class Trunk(nn.Module):
    """Either trunk, reading rows of `baselines.modular.segments.Nodes`."""

    def __init__(self, kind: Kind, features: int, extra: int = 0) -> None:
        super().__init__()
        self.kind, self.features = kind, features
        self.trunk = (GraphTrunk if kind == "gnn" else AttentionTrunk)(features + extra)

    def forward(self, rows: Tensor, *extra: Tensor) -> Tensor:
        """Hidden states (B, K, 128) of nodes with rows (B, K, columns) and further inputs (B, K, ...)."""
        edges = unpack(rows[..., self.features :], rows.shape[1]) if self.kind == "gnn" else None
        hidden: Tensor = self.trunk(torch.cat((rows[..., : self.features], *extra), -1), edges)
        return hidden


class ModularActor(SquashedActor):
    """A tanh-Gaussian of two muscles for every segment, with the weights of all segments shared."""

    def __init__(self, kind: Kind, features: int) -> None:
        super().__init__()
        self.trunk = Trunk(kind, features)
        self.head = nn.Sequential(nn.Linear(WIDTH, WIDTH), nn.ELU(), nn.Linear(WIDTH, 4))
        initialise(self)

    def sample(self, observation: Tensor, deterministic: bool = False) -> Sample:
        """Draw actions (B, K, 2) for rows (B, K, columns)."""
        mean, raw_std = self.head(self.trunk(observation)).float().chunk(2, -1)  # autocast may have reduced it
        return Sample(*sample_squashed_gaussian(mean, raw_std, deterministic), None)


class ModularCritics(nn.Module):
    """Twin critics without shared weights: a trunk that also reads actions, the mean over nodes, a perceptron."""

    optimizer: torch.optim.Optimizer

    def __init__(self, kind: Kind, features: int) -> None:
        super().__init__()
        self.trunks = nn.ModuleList(Trunk(kind, features, 2) for _ in range(2))
        self.values = nn.ModuleList(perceptron(WIDTH, 256, 256, 1) for _ in range(2))
        initialise(self)

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, ...]:
        """Values of both critics, (B, 1) each, for rows (B, K, columns) and actions (B, K, 2) or (B, 2 K)."""
        values = action.reshape(*observation.shape[:2], 2)
        pairs = zip(self.trunks, self.values, strict=True)
        return tuple(value(trunk(observation, values).mean(1)) for trunk, value in pairs)


class SegmentPolicy(StateBasedPolicy):
    """A modular policy, which acts on segments of the robot instead of the image; `baselines.load` returns one.

    It acts in the environment that is given to `attached`. Its memory is the segmentation: pass the second result of
    `predict` to the next call as ``state``, or robots are segmented anew in every step.

    Args:
        actor: The network.
        nodes: What it reads of segments, and how they act.
        description: What it is and where it comes from, see `cfp.policy.Policy.description`.
    """

    def __init__(self, actor: ModularActor, nodes: Nodes, description: dict[str, Any] | None = None) -> None:
        super().__init__(description)
        self.actor, self.nodes = actor, nodes

    @property
    def resolution(self) -> int:
        """R, rows and columns of its actions, which is the task's patch."""
        return int(self.description["resolution"])

    @property
    def num_inputs(self) -> int:
        """Number of features of a node that the network takes."""
        return self.actor.trunk.features

    def num_features(self, spec: TaskSpec) -> int:
        """Number of features of a node in a task."""
        return self.nodes.num_features(spec)

    def _act(self, env: TorchEnv, state: Memory, deterministic: bool) -> tuple[Tensor, Memory]:
        """Actions (B, 2, P, P), and the segment of every particle, (B, N)."""
        x, count = visible_positions(env), self.nodes.count
        if state is None:
            labels = fit(x, count)
        else:
            labels = update(x, torch.as_tensor(state[0], device=env.device), count)
            labels = segment(x, labels, count, env.env_state.steps == 0)
        device = next(self.actor.parameters()).device
        values = self.actor(self.nodes.observe(env, labels).to(device), deterministic)
        action = self.nodes.to_grid(env, labels, values.to(env.device))
        return from_grid_layout(action, trained_layout(self) or env.action_layout), (labels.cpu().numpy(),)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy to a file ``.safetensors``, and its description to a file ``.json`` beside it.

        Args:
            path: The file, whose name ends in ``.safetensors``.

        Raises:
            cfp.ConfigError: ``path`` has another suffix, or ``description`` is not complete, as it is for a policy that
                comes from no run.
        """
        trunk = self.actor.trunk
        network = {"kind": trunk.kind, "features": trunk.features}
        own = {"nodes": dataclasses.asdict(self.nodes), "network": network}
        write_policy(path, self.actor.state_dict(), self.description | own)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> SegmentPolicy:
        """Load a policy that `save` wrote.

        Args:
            path: The file ``.safetensors``, or another form that `cfp.load` takes.
            device: Device of its tensors.

        Raises:
            cfp.CheckpointError: The file is missing, damaged, or not such a policy.
        """
        tensors, description = read_policy(path, device)
        with report_mismatch(path):
            actor = load_network(lambda: ModularActor(**description["network"]), tensors, device)
            return cls(actor, Nodes(**description["nodes"]), description)
