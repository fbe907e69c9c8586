"""Teachers of a distillation: trained policies of any kind."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.common.open_loop import OpenLoop
from baselines.registry import load
from cfp.config import EnvironmentConfig
from cfp.policy import Policy, check_trained_for, read_policy
from cfp.resumable import Resumable
from dittogym import TorchEnv
from dittogym.action import ActionLayout, bicubic_matrix, from_grid_layout, to_grid_layout, trained_layout
from dittogym.render.recording import attached


class Teacher(Resumable):
    """Labels the states of an environment with the actions of a policy, without noise.

    An open-loop policy plays the action of the step that each episode is at.
    """

    def __init__(self, policy: Policy, action_layout: ActionLayout) -> None:
        self.policy, self.action_layout = policy, action_layout
        self._memory: tuple[np.ndarray, ...] | None = None

    @torch.no_grad()
    def act(self, env: TorchEnv, observation: Tensor) -> Tensor:
        """Mean actions (B, 2, R, R) for the present states, whose images are (B, 3, 64, 64)."""
        policy = attached(self.policy, env)
        steps = env.env_state.steps.cpu().numpy()
        memory = (steps,) if isinstance(policy, OpenLoop) else self._memory
        array, self._memory = policy.predict(observation.cpu().numpy(), memory, steps == 0, deterministic=True)
        own = trained_layout(self.policy) or self.action_layout
        return from_grid_layout(to_grid_layout(torch.as_tensor(array, device=env.device), own), self.action_layout)

    def state_dict(self) -> dict[str, Any]:
        """The policy's memory."""
        return {"memory": [torch.from_numpy(array) for array in self._memory or ()]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state of `state_dict`."""
        self._memory = tuple(array.numpy() for array in state["memory"]) or None


def project(actions: Tensor, resolution: int, patch: int) -> Tensor:
    """Actions on another grid that drive the muscles as similarly as possible, clipped to [-1, 1].

    With the bicubic interpolation ``U`` to the patch, they have the least squared difference from ``U a U^T`` there.
    """
    matrix = _projection(actions.shape[-1], resolution, patch).to(actions)
    return (matrix @ actions @ matrix.T).clamp(-1.0, 1.0)


@functools.lru_cache(maxsize=64)
def _projection(size: int, new_size: int, patch: int) -> Tensor:
    """Matrix (new_size, size) that enlarges to the patch, then applies the pseudo-inverse of enlarging."""
    cpu = torch.device("cpu")
    enlarge, enlarge_new = (bicubic_matrix(n, patch, False, torch.float64, cpu) for n in (size, new_size))
    return torch.linalg.pinv(enlarge_new) @ enlarge


def read_teacher(path: str | Path, task: str, environment: EnvironmentConfig) -> Policy:
    """Load a policy that can teach a task."""
    check_trained_for("teacher", read_policy(path)[1], task, environment)
    return load(path)
