"""Teachers of a distillation: a trained policy of any kind, or the gradient planner."""

import functools
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.common.open_loop import OpenLoop
from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig
from baselines.registry import load
from cfp.config import EnvironmentConfig
from cfp.policy import Policy, check_trained_for, read_policy
from cfp.resumable import Resumable
from dittogym import TorchEnv
from dittogym.action import ActionLayout, bicubic_matrix, from_grid_layout, to_grid_layout, trained_layout
from dittogym.render.recording import attached


class Teacher(Resumable, ABC):
    """Labels the present states of an environment with actions."""

    fresh: bool = True
    """Whether the last actions were computed from the present states. If not, they continue a plan, and are labels only
    for robots that have followed it."""

    @abstractmethod
    def act(self, env: TorchEnv, observation: Tensor) -> Tensor:
        """Actions (B, 2, R, R) for the present states, whose images are (B, 3, 64, 64)."""


class PolicyTeacher(Teacher):
    """A trained policy without noise; an open-loop one plays the action of the step that each episode is at."""

    def __init__(self, policy: Policy, action_layout: ActionLayout) -> None:
        self.policy, self.action_layout = policy, action_layout
        self._memory: tuple[np.ndarray, ...] | None = None

    @torch.no_grad()
    def act(self, env: TorchEnv, observation: Tensor) -> Tensor:
        """Mean actions (B, 2, R, R) of the policy."""
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


class PlannerTeacher(Teacher):
    """The gradient planner, which plans for all robots at once from the states that the student has reached."""

    parts = ("planner",)

    def __init__(self, env: TorchEnv, config: GradientPlannerConfig, seed: int) -> None:
        env.reset(seed=seed)
        self.env = env
        self.planner = GradientPlanner(env, config, seed=seed)

    def act(self, env: TorchEnv, observation: Tensor) -> Tensor:
        """The next actions (B, 2, R, R) of the plans."""
        self.env.env_state = env.env_state
        self.fresh = self.planner.needs_plan
        return self.planner.act().float()


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
