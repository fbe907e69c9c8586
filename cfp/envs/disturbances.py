"""Faults and changed constants under which a policy is tried, without learning."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn
from torch import Tensor

from cfp.config import RunConfig
from cfp.envs.make import make_torch_env
from cfp.envs.vec_env import monitored
from cfp.policy import Policy
from dittogym import make_spec
from dittogym.action import bicubic
from dittogym.geometry import Obstacle, floor
from dittogym.spec import TaskSpec

FLOOR = floor().name


@dataclass(frozen=True)
class Case:
    """One way to disturb a policy.

    Attributes:
        name: For tables and plots.
        action_dropout: Share of the policy's decisions that become 0, drawn anew in every step: of the 2 R R entries of
            its own grid, or what else it decides, see `Decides`.
        observation_dropout: Share of the 3 x 64 x 64 raw pixels that become 0, drawn anew in every step. A velocity
            pixel of 0 means fast motion, not rest, which is 132.
        action_noise: Standard deviation of Gaussian noise on every decision; 1 is the full actuation.
        latency: Control steps by which actions come late; the first ones of an episode are 0.
        physics: Factors on the task's own ``mu``, ``yield_stress`` and ``gravity``.
        friction: Coulomb coefficient of the floor; ``math.inf`` sticks. ``None``: the task's own.
    """

    name: str
    action_dropout: float = 0.0
    observation_dropout: float = 0.0
    action_noise: float = 0.0
    latency: int = 0
    physics: Mapping[str, float] = field(default_factory=dict)
    friction: float | None = None


def idle(case: Case, spec: TaskSpec, sees_image: bool = True) -> str:
    """Why a case changes nothing in a task for a policy; empty if it changes something.

    Args:
        case: One way to disturb it.
        spec: The task.
        sees_image: Whether the policy looks at pixels.
    """
    if case.observation_dropout and not sees_image:
        return "the policy looks at no pixels"
    if "gravity" in case.physics and not any(spec.gravity):
        return f"{spec.name} has no gravity"
    if case.friction is None:
        return ""
    floors = [item for item in spec.obstacles if item.name == FLOOR]
    if not floors:
        return f"{spec.name} has no obstacle with the name {FLOOR!r}"
    own = {rule.friction for item in floors for rule in item.rules}
    if not own:
        return f"the floor of {spec.name} has no rules"
    return f"the floor of {spec.name} has this friction" if own == {case.friction} else ""


def disturbed_env(
    config: RunConfig, resolution: int, num_envs: int, case: Case, seed: int, grid: int | None = None
) -> Disturbed:
    """The environment of a run under a case.

    Args:
        config: The run's options.
        resolution: Action grid R.
        num_envs: Robots side by side.
        case: What is disturbed.
        seed: Of the disturbances, and of a first reset that sets the constants.
        grid: Of the policy, see `Disturbed`.
    """
    spec = make_spec(config.task, **config.environment.task_options())
    options = {} if case.friction is None else {"obstacles": _with_friction(spec, case.friction)}
    env = make_torch_env(config, resolution, num_envs, **options)
    own = {name: np.asarray(getattr(spec, name), np.float64) for name in case.physics}
    env.reset(seed=seed, options={"physics": {name: own[name] * factor for name, factor in case.physics.items()}})
    return Disturbed(monitored(env), case, seed, grid)


def _with_friction(spec: TaskSpec, friction: float) -> tuple[Obstacle, ...]:
    return tuple(
        replace(item, rules=tuple(replace(rule, friction=friction) for rule in item.rules))
        if item.name == FLOOR
        else item
        for item in spec.obstacles
    )


def lose(values: Tensor, lost: Tensor) -> Tensor:
    """Values (B, ..., A, A) without what is lost (B, ..., R, R), bool: each entry takes its whole cell along."""
    if lost.shape != values.shape:
        size, grid = values.shape[-1], lost.shape[-1]
        cell = torch.arange(size, device=lost.device) * grid // size
        lost = lost[..., cell[:, None], cell]
    return values.masked_fill(lost, 0)


@runtime_checkable
class Decides(Protocol):
    """A policy that decides something else than a grid, from which its actions are painted."""

    def through(self, change: Callable[[np.ndarray], np.ndarray]) -> Policy:
        """The same policy, with ``change`` made to its decisions (B, ...) before its actions are painted from them."""


class Disturbed(VecEnvWrapper):
    """Disturbs actions and observations of a vectorised environment; the same from every ``reset`` on.

    A policy of several levels decides on a grid and hands over an enlarged blend. Its actions are disturbed on that
    grid: lost entries take away all that they became, noise is enlarged as the environment enlarges actions.

    Args:
        venv: The environment, with actions (B, 2, A, A) and observations uint8 (B, 3, 64, 64).
        case: What is disturbed; its constants of the matter are not applied here.
        seed: Of the generator, which every ``reset`` starts anew.
        grid: Rows and columns R of the grid on which the policy decides; A if None, 0 if it decides on none and calls
            `disturb` itself, see `Decides`.
    """

    def __init__(self, venv: VecEnv, case: Case, seed: int, grid: int | None = None) -> None:
        super().__init__(venv)
        self.case, self.seed_of_noise = case, seed
        assert self.action_space.shape is not None
        self.size = self.action_space.shape[-1]
        self.grid = self.size if grid is None else grid
        self._begin()

    def _begin(self) -> None:
        self.generator = np.random.default_rng(self.seed_of_noise)
        nothing = np.zeros((self.num_envs, 2, self.size, self.size), np.float32)
        self._late = deque(nothing.copy() for _ in range(self.case.latency))

    def reset(self) -> VecEnvObs:
        """Start new episodes, with the disturbances of the first time."""
        self._begin()
        return self._seen(self.venv.reset())

    def step_async(self, actions: np.ndarray) -> None:
        """Hand on what becomes of the actions (B, 2, A, A)."""
        self._late.append(np.array(actions, np.float32))
        actions = self._late.popleft()
        if self.grid:
            actions = self._disturbed(actions, (len(actions), 2, self.grid, self.grid))
        self.venv.step_async(actions)

    def disturb(self, decisions: np.ndarray) -> np.ndarray:
        """What becomes of decisions (B, ...) that are no grid."""
        return self._disturbed(decisions, decisions.shape)

    def _disturbed(self, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        """Values with noise and losses that are drawn in another shape."""
        found = torch.from_numpy(values)
        if self.case.action_noise:
            noise = torch.from_numpy(self.generator.standard_normal(shape, np.float32))
            found = found + self.case.action_noise * (noise if shape == values.shape else bicubic(noise, self.size))
        if self.case.action_dropout:
            found = lose(found, torch.from_numpy(self.generator.random(shape) < self.case.action_dropout))
        disturbed: np.ndarray = found.numpy()
        return disturbed

    def step_wait(self) -> VecEnvStepReturn:
        """Step; a new episode does not get the late actions of the one before."""
        observation, reward, done, infos = self.venv.step_wait()
        for actions in self._late:
            actions[done] = 0
        return self._seen(observation), reward, done, infos

    def _seen(self, observation: VecEnvObs) -> VecEnvObs:
        assert isinstance(observation, np.ndarray)
        if not self.case.observation_dropout:
            return observation
        lost = self.generator.random(observation.shape) < self.case.observation_dropout
        seen: np.ndarray = lose(torch.from_numpy(observation), torch.from_numpy(lost)).numpy()
        return seen


def make_cases(
    dropout: float = 0.2,
    noise: float = 0.2,
    latency: int = 1,
    shift: float = 0.2,
    friction: tuple[float, ...] = (0.0, 0.5, math.inf),
) -> list[Case]:
    """The cases of a report, the unperturbed one first.

    Args:
        dropout: Share of lost action and of lost observation entries.
        noise: Standard deviation of the action noise.
        latency: Control steps.
        shift: Constants of the matter are tried at 1 - shift and 1 + shift times their own value.
        friction: Coefficients of the floor.
    """
    cases = [
        Case("unperturbed"),
        Case(f"action dropout {100 * dropout:g}%", action_dropout=dropout),
        Case(f"observation dropout {100 * dropout:g}%", observation_dropout=dropout),
        Case(f"action noise {noise:g}", action_noise=noise),
        Case(f"latency {latency} step{'s' if latency > 1 else ''}", latency=latency),
    ]
    for name, symbol in (("mu", "mu"), ("yield_stress", "yield stress"), ("gravity", "gravity")):
        cases += [Case(f"{symbol} x {factor:g}", physics={name: factor}) for factor in (1 - shift, 1 + shift)]
    named = [("sticky" if math.isinf(value) else f"{value:g}", value) for value in friction]
    return cases + [Case(f"floor friction {name}", friction=value) for name, value in named]
