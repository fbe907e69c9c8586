"""Disturbances and changed constants under which policies are evaluated."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from torch import Tensor

from cfp.config import RunConfig
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import monitored
from dittogym.action import bicubic
from dittogym.geometry import floor
from dittogym.physics import has_effect
from dittogym.spec import TaskSpec

FLOOR = floor().name
FRICTION = (0.0, 0.5, math.inf)


@dataclass(frozen=True)
class Case:
    """One disturbance; dropout and noise are drawn anew in each step.

    A policy's decisions are the entries of its action grid, or those of `cfp.policy.DisturbablePolicy`.
    """

    name: str  # in tables and plots
    action_dropout: float = 0.0  # fraction of the decisions that are set to 0
    observation_dropout: float = 0.0  # fraction of the 3 x 64 x 64 pixels that are set to 0
    action_noise: float = 0.0  # standard deviation of Gaussian noise on each decision; 1 is the full actuation
    latency: int = 0  # delay of the actions in control steps; the first ones of an episode are 0
    physics: Mapping[str, float] = field(default_factory=dict)  # factors on the task's mu, yield_stress and gravity
    friction: float | None = None  # Coulomb coefficient of the floor; math.inf sticks, None keeps that of the task


def changes_something(case: Case, spec: TaskSpec, uses_image: bool = True) -> bool:
    """Whether a case has an effect on a policy in a task, or ``uses_image`` and the task's own constants forbid it."""
    if case.observation_dropout and not uses_image:
        return False
    if ("gravity" in case.physics and not any(spec.gravity)) or not all(
        has_effect(spec, name) for name in case.physics
    ):
        return False
    if case.friction is None:
        return True
    present = {rule.friction for item in spec.obstacles if item.name == FLOOR for rule in item.velocity_rules}
    return bool(present) and present != {case.friction}


def disturbed_env(
    config: RunConfig, resolution: int, case: Case, grid: int | None, seed: int, num_envs: int
) -> Disturbed:
    """Create the environment of a run with a disturbance; a first reset sets the constants of the physics."""
    spec = config.make_spec()
    obstacles = spec.obstacles
    if case.friction is not None:
        obstacles = tuple(item.with_friction(case.friction) if item.name == FLOOR else item for item in obstacles)
    env = make_torch_env(config, resolution, num_envs, obstacles=obstacles)
    own = {name: np.asarray(getattr(spec, name), np.float64) for name in case.physics}
    env.reset(seed=seed, options={"physics": {name: own[name] * factor for name, factor in case.physics.items()}})
    return Disturbed(monitored(env), case, seed, grid)


def drop(values: Tensor, mask: Tensor) -> Tensor:
    """Set entries of (B, ..., A, A) to 0, selected by a bool mask (B, ..., R, R) whose entries cover whole cells."""
    if mask.shape != values.shape:
        size, grid = values.shape[-1], mask.shape[-1]
        cell = torch.arange(size, device=mask.device) * grid // size
        mask = mask[..., cell[:, None], cell]
    return values.masked_fill(mask, 0)


class Disturbed(VecEnvWrapper):
    """Disturbs actions and observations of a vectorised environment, in the same way after each ``reset``.

    A policy of several stages returns an enlarged blend, which is disturbed on the grid on which it decides: a dropped
    entry clears its whole cell, noise is enlarged as actions are.

    Args:
        venv: The environment, with actions (B, 2, A, A) and observations uint8 (B, 3, 64, 64).
        case: The disturbance; its constants are not applied here.
        seed: Seed of the generator, which restarts at each ``reset``.
        grid: Rows and columns R of the grid on which the policy decides; None: A.
    """

    def __init__(self, venv: VecEnv, case: Case, seed: int, grid: int | None = None) -> None:
        super().__init__(venv)
        self.case, self.noise_seed = case, seed
        assert self.action_space.shape is not None
        self.size = self.action_space.shape[-1]
        self.grid = grid or self.size
        self.disturbs_actions = True  # not with a `DisturbablePolicy`, which calls `disturb` itself
        self._restart()

    def _restart(self) -> None:
        self.generator = np.random.default_rng(self.noise_seed)
        shape = (self.num_envs, 2, self.size, self.size)
        self._delayed = deque(np.zeros(shape, np.float32) for _ in range(self.case.latency))

    def reset(self) -> VecEnvObs:
        """Start new episodes, and the sequence of disturbances anew."""
        self._restart()
        return self._disturb_observation(self.venv.reset())

    def step_async(self, actions: np.ndarray) -> None:
        """Pass on disturbed actions (B, 2, A, A)."""
        self._delayed.append(np.array(actions, np.float32))
        actions = self._delayed.popleft()
        if self.disturbs_actions:
            actions = self.disturb(actions, (len(actions), 2, self.grid, self.grid))
        self.venv.step_async(actions)

    def disturb(self, values: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """Apply noise and dropout to values (B, ...), drawn in ``shape`` or for each of them."""
        shape = shape or values.shape
        if self.case.action_noise:
            noise = self.generator.standard_normal(shape, np.float32)
            if shape != values.shape:
                noise = bicubic(torch.from_numpy(noise), self.size).numpy()
            values = values + np.float32(self.case.action_noise) * noise
        if self.case.action_dropout:
            mask = torch.from_numpy(self.generator.random(shape) < self.case.action_dropout)
            values = drop(torch.from_numpy(values), mask).numpy()
        return values

    def step_wait(self) -> VecEnvStepReturn:
        """Step; delayed actions of an ended episode are cleared."""
        observation, reward, done, infos = self.venv.step_wait()
        for actions in self._delayed:
            actions[done] = 0
        return self._disturb_observation(observation), reward, done, infos

    def _disturb_observation(self, observation: VecEnvObs) -> VecEnvObs:
        assert isinstance(observation, np.ndarray)
        if not self.case.observation_dropout:
            return observation
        mask = self.generator.random(observation.shape) < self.case.observation_dropout
        return np.where(mask, observation.dtype.type(0), observation)


def make_cases(
    dropout: float = 0.2, noise: float = 0.2, latency: int = 1, shift: float = 0.2, friction: Sequence[float] = FRICTION
) -> list[Case]:
    """The cases of a robustness report, the unperturbed one first; constants are multiplied by 1 -+ ``shift``."""
    percent = f"{100 * dropout:g}%"
    cases = [
        Case("unperturbed"),
        Case(f"action dropout {percent}", action_dropout=dropout),
        Case(f"observation dropout {percent}", observation_dropout=dropout),
        Case(f"action noise {noise:g}", action_noise=noise),
        Case(f"latency {latency} step{'s' if latency > 1 else ''}", latency=latency),
    ]
    for name in ("mu", "yield_stress", "gravity"):
        label = name.replace("_", " ")
        cases += [Case(f"{label} x {factor:g}", physics={name: factor}) for factor in (1 - shift, 1 + shift)]
    named = [("sticky" if math.isinf(value) else f"{value:g}", value) for value in friction]
    return cases + [Case(f"floor friction {name}", friction=value) for name, value in named]
