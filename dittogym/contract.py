"""The interface between the environment and a task: moments and measurements in, outcomes out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from dittogym.reward_ops import RewardOps
from torchmpm import ParticleState
from torchmpm.materials.linalg import safe_sqrt

#: Terms that the environment adds to those of a task.
RESERVED_TERMS = frozenset({"split", "action", "alive", "failure"})
#: What the environment puts into ``info``, and what Gymnasium does.
RESERVED_INFO = frozenset({"com", "split", "finite", "object_com", "reward_terms", "is_success", "true_reward"})
RESERVED_INFO |= {"episode", "final_obs", "final_info"}


class Measurement(NamedTuple):
    """Averages over bodies at one moment.

    Attributes:
        com: (B, 2) mean position of the robot's particles in the world, m.
        velocity: (B, 2) their mean velocity, m/s.
        split: (B,) spread of the robot, sqrt(Var x + Var y), m.
        object_com: (B, 2) mean position of the object's particles, m; ``None`` in tasks without an object.
        object_velocity: (B, 2) their mean velocity, m/s.
    """

    com: Tensor
    velocity: Tensor
    split: Tensor
    object_com: Tensor | None = None
    object_velocity: Tensor | None = None


def measure(particles: ParticleState, num_robot_particles: int) -> Measurement:
    """Averages over the robot, whose particles come first, and over the object if there is one."""
    x, v = particles.x, particles.v
    robot, other = slice(None, num_robot_particles), slice(num_robot_particles, None)
    com = x[:, robot].mean(1)
    variance = (x[:, robot] - com[:, None]).square().mean(1).sum(-1)  # several times faster than Tensor.var
    split = safe_sqrt(variance)
    if num_robot_particles == x.shape[1]:
        return Measurement(com, v[:, robot].mean(1), split)
    return Measurement(com, v[:, robot].mean(1), split, x[:, other].mean(1), v[:, other].mean(1))


class Moment(NamedTuple):
    """What a reward function may look at after a step.

    Attributes:
        particles: The state of all particles.
        num_robot_particles: The robot's particles come first.
        now: Averages after the step.
        start: Averages right after the reset.
        observation: (B, 3, 64, 64) uint8, or for a smooth reward that of :func:`dittogym.core.soft_observation`.
        memory: What the task remembers, tensors with a leading B.
        ops: Operations that have a smooth form, see :class:`dittogym.reward_ops.RewardOps`.
    """

    particles: ParticleState
    num_robot_particles: int
    now: Measurement
    start: Measurement
    observation: Tensor
    memory: Mapping[str, Tensor]
    ops: RewardOps

    @property
    def robot_x(self) -> Tensor:
        """Positions (B, n, 2) of the robot's particles, m."""
        return self.particles.x[:, : self.num_robot_particles]

    @property
    def object_com(self) -> Tensor:
        """Mean position (B, 2) of the object's particles, m.

        Raises:
            ValueError: The task has no object.
        """
        if self.now.object_com is None:
            raise ValueError("object_com needs a task with an object, got one without")
        return self.now.object_com


class Outcome(NamedTuple):
    """What a reward function returns.

    Attributes:
        terms: Reward terms (B,) by name. The environment multiplies each by its weight in ``TaskSpec.weights`` and adds
            the terms ``split``, ``action``, ``alive`` and ``failure``.
        terminated: (B,) bool, the task's own reasons to end the episode; ``None`` if there are none.
        success: (B,) bool; ``None`` where success is not defined.
        info: Further quantities for ``info``, with a leading B.
        memory: Replaces the memory, leading B, with the same names and shapes; ``None`` keeps it. Tensors of int64 of
            shape (B, K) hold particle indices, which planners with fewer particles translate.
    """

    terms: Mapping[str, Tensor]
    terminated: Tensor | None = None
    success: Tensor | None = None
    info: Mapping[str, Tensor] | None = None
    memory: Mapping[str, Tensor] | None = None


Memory: TypeAlias = Mapping[str, Tensor]


def check_memory(task: str, memory: object, stale: tuple[str, ...], batch: int) -> None:
    """Refuse what a task must not return as its initial memory."""
    who = f"initial_memory of task {task!r}"
    if not isinstance(memory, Mapping):
        raise TypeError(f"{who} must return tensors by name, got {kind_of(memory)}")
    _check_leading(who, "memory", memory, batch)
    if missing := [name for name in stale if name not in memory]:
        raise ValueError(f"{who} must return what stale_memory names, got {sorted(memory)} without {missing}")


def check_outcome(task: str, outcome: object, memory: Memory, weights: Mapping[str, float], batch: int) -> None:
    """Refuse what a task must not return from a step."""
    who = f"reward_fn of task {task!r}"
    if not isinstance(outcome, Outcome):
        raise TypeError(f"{who} must return an Outcome, got {type(outcome).__name__}")
    parts = {"terms": outcome.terms, "info": outcome.info, "memory": outcome.memory}
    for what, values in parts.items():
        if not isinstance(values, Mapping) and (values is not None or what == "terms"):
            raise TypeError(f"{who} must return {what} by name, got {kind_of(values)}")
    flags = {"terminated": outcome.terminated, "success": outcome.success}
    info = outcome.info or {}
    for part, taken in (("terms", RESERVED_TERMS & outcome.terms.keys()), ("info", RESERVED_INFO & info.keys())):
        if taken:
            raise ValueError(f"{who} must not return the environment's own {part}, got {sorted(taken)}")
    for name in (*outcome.terms, *info):  # Gymnasium puts a mask _name beside every entry of a batch's info
        if not isinstance(name, str) or name.startswith(("_", "reward_terms/")):
            raise ValueError(f"{who} must return names that do not begin with _ or reward_terms/, got {name!r}")
    if missing := [name for name in outcome.terms if name not in weights]:
        raise ValueError(f"weights of task {task!r} must hold every term of reward_fn, got none for {missing}")
    for name, value in outcome.terms.items():
        if not isinstance(value, Tensor) or value.shape != (batch,) or value.is_complex():
            found = f"{kind_of(value)} for {name!r}"
            raise ValueError(f"{who} must return terms of shape (B,) in real numbers, got {found}")
    weighted = {*outcome.terms, *RESERVED_TERMS} - {"failure"}  # the penalty of a failure has its own amount
    if unknown := sorted(weights.keys() - weighted):
        allowed = sorted(weighted)
        raise ValueError(f"weights of task {task!r} must be of the terms {allowed}, got {unknown}")
    for name, flag in flags.items():
        if flag is not None and not (isinstance(flag, Tensor) and (flag.dtype, *flag.shape) == (torch.bool, batch)):
            raise ValueError(f"{who} must return {name} as bool of shape (B,), got {kind_of(flag)}")
    _check_leading(who, "info", info, batch)
    if outcome.memory is not None:
        before, after = ({name: kind_of(value) for name, value in m.items()} for m in (memory, outcome.memory))
        if before != after:
            raise ValueError(f"{who} must return memory like that of initial_memory, {before}, got {after}")


def _check_leading(who: str, what: str, values: Mapping[str, object], batch: int) -> None:
    for name, value in values.items():
        if not isinstance(value, Tensor) or value.shape[:1] != (batch,):
            raise ValueError(f"{who} must return {what} of shape (B, ...), got {kind_of(value)} for {name!r}")


def kind_of(value: object) -> str:
    """Type and shape of a tensor, type of anything else, for messages."""
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
