"""Teachers of a distillation: a trained policy of any kind, which may be trained first, or the gradient planner."""

import functools
import time
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.common.open_loop import OpenLoop
from baselines.distillation.config import DistillConfig
from baselines.planning.gradient import GradientPlanner, GradientPlannerConfig
from baselines.registry import configure, find, load
from cfp.config import TASK_OPTIONS, EnvironmentConfig
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.folder import policy_path
from cfp.experiment.process import StopSignals
from cfp.experiment.run import TrainingRun
from cfp.files import read_json, write_json
from cfp.hub import is_address
from cfp.learner import Resumable
from cfp.policy import Policy, StatePolicy, check_trained_for, copy_policy, read_policy, shipped
from dittogym import TorchEnv
from dittogym.action import ActionLayout, bicubic_matrix, from_grid_layout, to_grid_layout, trained_layout

#: Teachers that are trained first if only their algorithm is named.
TRAINED = ("shac", "gradient")


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

    def __init__(self, policy: Policy, indexing: ActionLayout) -> None:
        self.policy, self.indexing = policy, indexing
        self._memory: tuple[np.ndarray, ...] | None = None

    @torch.no_grad()
    def act(self, env: TorchEnv, observation: Tensor) -> Tensor:
        """Mean actions (B, 2, R, R) of the policy."""
        policy = self.policy.attached(env) if isinstance(self.policy, StatePolicy) else self.policy
        steps = env.env_state.steps.cpu().numpy()
        memory = (steps,) if isinstance(policy, OpenLoop) else self._memory
        array, self._memory = policy.predict(observation.cpu().numpy(), memory, steps == 0, deterministic=True)
        own = trained_layout(self.policy) or self.indexing
        return from_grid_layout(to_grid_layout(torch.as_tensor(array, device=env.device), own), self.indexing)

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


def teacher_path(folder: Path) -> Path:
    """The copy of the teacher in the folder of a run."""
    return folder / "teacher.safetensors"


def copy_teacher(config: DistillConfig, folder: Path) -> None:
    """Copy the teacher into the folder, if it is a policy; else remove what an earlier attempt has left there."""
    teacher = config.teacher
    if teacher in ("mpc", *TRAINED):
        teacher_path(folder).unlink(missing_ok=True)
        return
    try:
        read_teacher(teacher, config.task, config.environment)
    except CheckpointError as error:
        if Path(teacher).exists() or is_address(teacher):
            raise
        names = ", ".join(("mpc", *TRAINED, *shipped()))
        raise ConfigError(f"teacher must be {names}, a run folder or a policy.safetensors, got {teacher!r}") from error
    copy_policy(teacher, teacher_path(folder))


def warnings(config: DistillConfig, folder: Path) -> list[str]:
    """A warning if the teacher is the record of one episode, in a task whose episodes start differently."""
    if config.teacher in ("mpc", *TRAINED) or "layout" not in read_policy(teacher_path(folder))[1]:
        return []
    if not any(body.shape.draws for body in config.make_spec().bodies):
        return []
    return [
        f"teacher: the record of one planned episode, while every episode of {config.task} starts differently; "
        "evaluate it from other starts (python -m baselines.evaluate --policy), or use mpc, which plans anew"
    ]


def train_teacher(config: DistillConfig, folder: Path, signals: StopSignals) -> None:
    """Train a teacher that is only named and not there yet; what this took is added up in ``teacher/cost.json``."""
    if config.teacher not in TRAINED or teacher_path(folder).exists():
        return
    chosen = configure({"algo": config.teacher, "task": config.task})
    same = {name: getattr(config, name) for name in ("substeps", "dt", "dtype", "backend", *TASK_OPTIONS)}
    chosen = replace(chosen, seed=config.seed, device=config.device, **same)
    algorithm, own = find(config.teacher), folder / "teacher"
    run = TrainingRun(algorithm, chosen, own, True, signals)
    print(f"training the teacher first: {config.teacher} -> {own}")
    start, begin = run.step, time.perf_counter()
    try:
        run.train()
    finally:
        cost = {"steps": run.step - start, "seconds": time.perf_counter() - begin}
        cost["evaluation_seconds"] = run.evaluation_seconds
        path = own / "cost.json"
        before = read_json(path) if path.exists() else {}
        write_json(path, {name: value + before.get(name, 0) for name, value in cost.items()})
    copy_policy(policy_path(own), teacher_path(folder))
