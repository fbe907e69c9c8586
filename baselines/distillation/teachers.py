"""What a policy of images is taught by: a policy of any other kind, or the planner."""

from __future__ import annotations

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
from cfp.policy import Policy, SeesState
from cfp.sections import EnvironmentConfig
from cfp.weights import check_trained_for, read_policy
from dittogym import TorchEnv, make_spec
from dittogym.action import ActionIndexing, bicubic_matrix, from_grid_indexing, to_grid_indexing


class Teacher(ABC):
    """Says what should be done in the present states of an environment.

    Attributes:
        resolution: Its action grid R.
        fresh: Whether its last answer came from the states themselves; otherwise it is right only for robots that have
            done as they were told since it last did.
    """

    resolution: int
    fresh: bool = True

    @abstractmethod
    def act(self, env: TorchEnv, seen: Tensor) -> Tensor:
        """Actions (B, 2, R, R) for the present states, which are seen as images (B, 3, 64, 64)."""

    def state_dict(self) -> dict[str, Any]:
        """What its next answer depends on beside the environment."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:  # noqa: B027  (most remember nothing)
        """Undo `state_dict`."""


class PolicyTeacher(Teacher):
    """A trained policy, without noise. A sequence of actions is read at the step that an episode has come to.

    What other policies remember is handed back to them, and begins anew where an episode does.

    Args:
        policy: Of any kind.
        theirs: ActionIndexing of its actions, see `dittogym.TorchEnv`.
        layout: The one that is wanted.
    """

    def __init__(self, policy: Policy, theirs: ActionIndexing, layout: ActionIndexing) -> None:
        self.policy, self.theirs, self.layout = policy, theirs, layout
        self.resolution = policy.resolution
        self._memory: tuple[np.ndarray, ...] | None = None

    @torch.no_grad()
    def act(self, env: TorchEnv, seen: Tensor) -> Tensor:
        """Its mean actions."""
        policy = self.policy.attached(env) if isinstance(self.policy, SeesState) else self.policy
        steps = env.env_state.steps.cpu().numpy()
        memory = (steps,) if isinstance(policy, OpenLoop) else self._memory
        array, self._memory = policy.predict(seen.cpu().numpy(), memory, steps == 0, deterministic=True)
        action = torch.as_tensor(array, device=env.device)
        return from_grid_indexing(to_grid_indexing(action, self.theirs), self.layout)

    def state_dict(self) -> dict[str, Any]:
        """What the policy remembers."""
        return {"memory": [torch.from_numpy(array) for array in self._memory or ()]}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        arrays = state.get("memory")  # checkpoints from before have none
        self._memory = tuple(array.numpy() for array in arrays) if arrays else None


class PlannerTeacher(Teacher):
    """The gradient planner, from wherever the student has got to.

    It plans for all robots at once, every `PlannerConfig.commit` steps, each plan from what is left of the one before.

    Args:
        env: Of its own, with its action grid; it follows the one that it is asked about.
        config: How to plan.
        seed: Of the plans' noise.
    """

    def __init__(self, env: TorchEnv, config: GradientPlannerConfig, seed: int) -> None:
        env.reset(seed=seed)
        self.env, self.resolution = env, env.action_resolution
        self.planner = GradientPlanner(env, config, seed=seed)

    def act(self, env: TorchEnv, seen: Tensor) -> Tensor:
        """The next actions of its plans."""
        self.env.env_state = env.env_state
        with torch.enable_grad():
            action = self.planner.act()
        self.fresh = self.planner.has_replanned
        return action.float()

    def state_dict(self) -> dict[str, Any]:
        """The plans."""
        return self.planner.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Undo `state_dict`."""
        self.planner.load_state_dict(state)


def project(actions: Tensor, resolution: int, patch: int) -> Tensor:
    """Actions on another grid that drive the muscles as much alike as they can.

    The environment enlarges a grid to the patch by half-pixel bicubic interpolation, ``U``. What is returned has the
    least squared difference from ``U a U^T`` there, cut to [-1, 1]: exact wherever the wanted grid can follow, such as
    for R itself and for the patch.

    Args:
        actions: (..., R, R).
        resolution: The wanted grid S.
        patch: Width of the environment's patch in nodes.

    Returns:
        (..., S, S).
    """
    matrix = _projection(actions.shape[-1], resolution, patch).to(actions)
    return (matrix @ actions @ matrix.T).clamp(-1.0, 1.0)


@functools.lru_cache(maxsize=64)
def _projection(before: int, after: int, patch: int) -> Tensor:
    """Matrix (after, before): enlarge, then the least-squares inverse of enlarging."""
    cpu = torch.device("cpu")
    given, wanted = (bicubic_matrix(size, patch, False, torch.float64, cpu) for size in (before, after))
    return torch.linalg.pinv(wanted) @ given


def read_teacher(path: str | Path, task: str, environment: EnvironmentConfig) -> Policy:
    """Load a policy that can teach a task.

    Args:
        path: A run folder, a ``.safetensors`` file, or the ``.json`` beside one.
        task: What the student shall do.
        environment: Where it shall do it.

    Raises:
        ConfigError: It was trained for something else, or cannot be asked about other states than its own.
        CheckpointError: There is no such policy, or it is damaged.
    """
    check_trained_for("teacher", read_policy(path)[1], task, environment)
    return load(path)


def is_record_of_another_start(teacher: Policy, task: str, environment: EnvironmentConfig) -> bool:
    """Whether a teacher plays what was planned for one episode, in a task whose episodes start differently."""
    drawn = any(body.shape.draws for body in make_spec(task, **environment.task_options()).bodies)
    return drawn and "layout" in teacher.description
