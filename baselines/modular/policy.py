"""A trained modular policy by itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from baselines.modular.env import segmented
from baselines.modular.kmeans import follow
from baselines.modular.networks import ModularActor
from baselines.modular.nodes import Nodes, places
from baselines.shac.networks import shown
from cfp.weights import fitting, read_policy, write_policy
from dittogym import TorchEnv


class SegmentPolicy:
    """Acts on the segments of the robots in the environment that it is shown by `attached`, not on the image.

    Its memory is the segmentation: hand the second result of `predict` back as ``state``, or robots are segmented anew.

    Args:
        actor: The network.
        nodes: How segments are seen and act.
        description: What it is and comes from.
        env: Where it looks.
        change: What becomes of its decisions, see `through`.
    """

    sees_image = False

    def __init__(
        self,
        actor: ModularActor,
        nodes: Nodes,
        description: dict[str, Any] | None = None,
        env: TorchEnv | None = None,
        change: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self.actor, self.nodes, self.env, self.change = actor, nodes, env, change
        self.description = description or {}

    @property
    def resolution(self) -> int:
        """Action grid R of the environment that it acts in."""
        return int(self.description["resolution"])

    @property
    def deterministic_by_default(self) -> bool:
        """Whether the run that trained it evaluates it without noise."""
        return bool(self.description.get("deterministic", False))

    def attached(self, env: TorchEnv) -> SegmentPolicy:
        """The same policy, looking at the environment ``env``.

        Raises:
            ValueError: Another task's environment, with other things to see.
        """
        found, features = self.nodes.features(env.spec), self.actor.trunk.features
        if found != features:
            raise ValueError(f"env: got {env.spec.name!r} with {found} features, allowed {features}")
        return SegmentPolicy(self.actor, self.nodes, self.description, env, self.change)

    def through(self, change: Callable[[np.ndarray], np.ndarray]) -> SegmentPolicy:
        """The same policy, with ``change`` made to its decisions (B, K, 2) before they are painted on the patch."""
        return SegmentPolicy(self.actor, self.nodes, self.description, self.env, change)

    @torch.no_grad()
    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Actions (B, 2, P, P) for the state of the attached environment, as stable-baselines3's ``predict``.

        Args:
            observation: (B, 3, 64, 64) or (3, 64, 64); only the number of images matters.
            state: What the last call returned, None at the beginning: the segment of every particle, (B, N).
            episode_start: (B,) bool; changes nothing: the environment knows which of its episodes begin, while
                stable-baselines3's ``evaluate_policy`` leaves this true for elements that have played theirs.
            deterministic: Without noise.

        Raises:
            RuntimeError: It was not shown an environment.
            ValueError: The images are not as many as the environment has simulations.
        """
        env, single = shown(self.env, observation)
        anew, labels = env.env_state.steps == 0, None
        if state is None:
            anew = torch.ones_like(anew)
        else:
            labels = torch.as_tensor(state[0], device=env.device)
            labels = follow(places(env), labels, self.nodes.count)
        labels = segmented(env, self.nodes, labels, anew)
        device = next(self.actor.parameters()).device
        values = self.actor(self.nodes(env, labels).to(device), deterministic)
        if self.change is not None:
            values = torch.from_numpy(self.change(values.cpu().numpy()))
        values = values.to(env.device)
        actions = self.nodes.act(env, labels, values).float().cpu().numpy()
        return actions[0] if single else actions, (labels.cpu().numpy(),)

    def save(self, path: Path) -> None:
        """Write ``path`` (``.safetensors``) and the ``.json`` beside it."""
        trunk = self.actor.trunk
        own = {"nodes": dataclasses.asdict(self.nodes), "network": {"kind": trunk.kind, "features": trunk.features}}
        write_policy(path, self.actor.state_dict(), self.description | own)

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> SegmentPolicy:
        """Load what `save` wrote.

        Raises:
            CheckpointError: No such file, a damaged one, or one that is not such a policy.
        """
        tensors, description = read_policy(path, device)
        with fitting(path):
            with torch.device("meta"):  # so that a size that the file only claims takes no memory
                actor = ModularActor(**description["network"])
            actor.load_state_dict(tensors, assign=True)
            actor.to(device, torch.float32).requires_grad_(False)
            return cls(actor, Nodes(**description["nodes"]), description)
