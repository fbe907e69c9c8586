"""Conditions that differ from episode to episode: starts, constants of the matter, and disturbances of every step.

What is random depends on nothing but the seed of an element's episode and the number of the step, so that an element
has the same episode in a batch of any size, and a saved state continues as it did.
"""

from __future__ import annotations

import itertools
import math
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dittogym.action import bicubic
from dittogym.bodies.positions import check_robot_at, probe
from dittogym.copies import to_device
from dittogym.physics import Physics, has_effect, value_of
from dittogym.spec import TaskSpec
from torchmpm import checks

#: What the conditions of B episodes are, and what they remember: tensors by name, with a leading B.
Drawn: TypeAlias = Mapping[str, Tensor]
#: Bounds of a uniform distribution; a single number stands for both.
Interval: TypeAlias = "float | tuple[float, float]"

#: Streams of random numbers.
_CHANCE, _VALUE, _NOISE, _ACTION, _PIXEL, _NEXT = range(6)
#: Constants of the matter whose factors are drawn.
_FACTORS = ("mu", "yield_stress", "gravity")
#: What an episode draws, in the order of its random numbers.
_NAMES = ("latency", "action_noise", "action_dropout", "observation_dropout", *_FACTORS, "shift", "turn", "velocity")
#: Degrees between the directions in which a turned robot is tried.
TURN_STEP = 11.25
#: Bounds of values; that of ``shift``, m, is the height of the window.
_HIGHEST = {"action_dropout": 1.0, "observation_dropout": 1.0, "chance": 1.0, "shift": 1.0}
#: Fields that are not ranges.
_SINGLE = ("shift", "turn", "velocity", "chance")


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Ranges from which each episode draws its conditions, for training under domain randomisation and for tests.

    A pair (lowest, highest) is a range from which each episode draws uniformly. A single number always applies, except
    that ``shift``, ``turn`` and ``velocity`` are largest values. The defaults change nothing. A factor has no effect in
    a task whose bodies do not take the constant, or that has no gravity. Rewards, ``info`` and pictures show what
    happens, not what the policy sees. The conditions of the present episodes are in ``env.env_state.conditions``,
    tensors by name with a leading B, and the constants of their matter in ``env.env_state.physics``.

    Raises:
        ValueError: A range is not in order, or a number is out of bounds. The environment also raises one if it has no
            room for a start, or if its substeps are too long for the matter.

    Examples:
        >>> import dittogym
        >>> conditions = dittogym.Conditions(latency=(0, 2), action_dropout=0.2, mu=(0.8, 1.2), turn=5.0)
        >>> env = dittogym.TorchEnv("run", num_envs=4, particles="lite", conditions=conditions)
        >>> observation, info = env.reset(seed=0)
        >>> late = env.env_state.conditions["latency"]  # of each episode
        >>> late.shape, bool((late <= 2).all())
        (torch.Size([4]), True)
    """

    latency: int | tuple[int, int] = 0
    """Control steps by which actions come late, whole numbers from 0; the first actions of an episode are 0."""
    action_noise: Interval = 0.0
    """Standard deviation of normal noise on each entry of an action, new in every step; 1 is full actuation."""
    action_dropout: Interval = 0.0
    """Share of the entries of an action that are set to 0, from 0 to 1; they are chosen anew in every step."""
    observation_dropout: Interval = 0.0
    """Share of the 3 x 64 x 64 entries of an observation that are set to 0, from 0 to 1; chosen anew in every step."""
    mu: Interval = 1.0
    """Factor on the second Lame parameter of the robot, and of an object without a material of its own; positive."""
    yield_stress: Interval = 1.0
    """Factor on the yield stress of the robot, not negative."""
    gravity: Interval = 1.0
    """Factor on gravity, not negative."""
    shift: float = 0.0
    """Largest distance, m, by which the robot's start is moved in x and in y, but not downwards; at most 1."""
    turn: float = 0.0
    """Largest angle, degrees, by which the robot is turned at the start, to either side."""
    velocity: float = 0.0
    """Largest velocity, m/s, of the robot at the start, in x and in y, in either direction."""
    chance: float = 1.0
    """Probability with which each of the conditions above applies to an episode, from 0 to 1."""
    grid: int | None = None
    """Rows and columns of the grid on which noise and missing entries of actions are drawn, for a policy that decides
    on a smaller grid than that of its actions; ``None``: the grid of the actions."""

    def __post_init__(self) -> None:
        if self.grid is not None:
            checks.whole("grid", self.grid, 1)
        for name in (*_NAMES, "chance"):
            given = getattr(self, name)
            pair = isinstance(given, list | tuple)
            if pair and (name in _SINGLE or len(given) != 2):
                allowed = "a number" if name in _SINGLE else "a number or a pair (lowest, highest)"
                raise ValueError(f"{name} must be {allowed}, got {given}")
            low, high = (_checked(name, part) for part in (given if pair else (given, given)))
            if low > high:
                raise ValueError(f"{name} must be a pair (lowest, highest), got {given}")
            if pair:
                object.__setattr__(self, name, (low, high))

    def bounds(self, name: str) -> tuple[Any, Any]:
        """Lowest and highest value of the field ``name``."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @property
    def hides_pixels(self) -> bool:
        """Whether images may lose entries."""
        return self.bounds("observation_dropout")[1] > 0

    @property
    def moves_start(self) -> bool:
        """Whether starts differ."""
        return any((self.shift, self.turn, self.velocity))

    def changes(self, spec: TaskSpec) -> list[str]:
        """The constants of the matter that these conditions change in the task ``spec``."""
        changed = [name for name in _FACTORS if self.bounds(name) != (1.0, 1.0) and has_effect(spec, name)]
        return changed if any(spec.gravity) else [name for name in changed if name != "gravity"]


def as_conditions(given: Any) -> Conditions | None:
    """Conditions as they are; a mapping, such as JSON holds, by the names of the fields."""
    if given is None or isinstance(given, Conditions):
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"conditions must be dittogym.Conditions or a mapping, got {type(given).__name__}")
    names = [each.name for each in fields(Conditions)]
    if unknown := [name for name in given if name not in names]:
        raise ValueError(f"conditions may hold {', '.join(names)}, got {', '.join(map(repr, unknown))}")
    return Conditions(**given)


def _checked(name: str, value: Any) -> float:
    if name == "latency":
        return checks.whole(name, value, 0)
    checks.number(name, value, **({"above": 0.0} if name == "mu" else {"least": 0.0}), most=_HIGHEST.get(name))
    return float(value)


# Random numbers.


def _mixed(x: Tensor) -> Tensor:
    """A hash of whole numbers (the finaliser of SplitMix64; Steele et al., OOPSLA 2014), with int64 that wraps."""
    for shift, factor in ((30, -0x40A7B892E31B1A47), (27, -0x6B2FB644ECCEEE15)):
        x = (x ^ ((x >> shift) & ((1 << (64 - shift)) - 1))) * factor
    return x ^ ((x >> 31) & ((1 << 33) - 1))


def _bits(seed: Tensor, stream: int, step: Tensor | int, count: int) -> Tensor:
    """Random whole numbers (B, count), which depend on the seed (B,), the stream and the step."""
    keys = _mixed(_mixed(_mixed(seed) + stream) + step)
    index = torch.arange(1, count + 1, device=seed.device)
    return _mixed(keys[:, None] - 0x61C8864680B583EB * index)


def uniform(seed: Tensor, stream: int, step: Tensor | int, count: int) -> Tensor:
    """Random numbers (B, count) in [0, 1), float32, of seeds (B,)."""
    return ((_bits(seed, stream, step, count) >> 40) & 0xFFFFFF).float() * 2.0**-24


def _chosen(seed: Tensor, stream: int, step: Tensor, share: Tensor, shape: Sequence[int]) -> Tensor:
    """Random entries (B, *shape), bool, each chosen with the probability ``share`` (B,), rounded to 16 bits."""
    count = math.prod(shape)
    numbers = _bits(seed, stream, step, math.ceil(count / 4)).view(torch.int16)[:, :count]  # four from one hash
    return (numbers < (2.0**16 * share - 2.0**15)[:, None]).view(-1, *shape)


def _normal(seed: Tensor, stream: int, step: Tensor, count: int) -> Tensor:
    """Normal random numbers (B, count) (Box and Muller)."""
    first, second = uniform(seed, stream, step, 2 * count).unflatten(1, (2, count)).unbind(1)
    return (-2.0 * torch.log1p(-first)).sqrt() * (2.0 * math.pi * second).cos()


# Episodes.


def draw(conditions: Conditions, seeds: Tensor, action_shape: Sequence[int], like: Tensor) -> Drawn:
    """The conditions of episodes with these seeds (B,) int64.

    Args:
        conditions: Their ranges.
        seeds: Of the episodes.
        action_shape: (2, R, R).
        like: Gives dtype and device.
    """
    chosen = uniform(seeds, _CHANCE, 0, len(_NAMES)) < conditions.chance
    # In float64, in which neither bounds nor whole numbers are rounded; shift and velocity have two axes.
    numbers = uniform(seeds, _VALUE, 0, len(_NAMES) + 2).double()
    drawn: dict[str, Tensor] = {"seed": seeds}
    for i, name in enumerate(_NAMES):
        low, high = conditions.bounds(name)
        where, number = chosen[:, i], numbers[:, i]
        if name == "latency":
            drawn[name] = torch.where(where, (low + number * (high - low + 1)).long(), 0)
        elif name in ("shift", "velocity"):
            two = torch.stack((number, numbers[:, len(_NAMES) + (name == "velocity")]), 1)
            drawn[name] = torch.where(where[:, None], high * (2.0 * two - 1.0), 0.0).to(like)
        elif name == "turn":
            drawn[name] = torch.where(where, math.radians(high) * (2.0 * number - 1.0), 0.0).to(like)
        else:
            neutral = 1.0 if name in _FACTORS else 0.0
            drawn[name] = torch.where(where, low + number * (high - low), neutral).to(like)
    if steps := conditions.bounds("latency")[1]:
        drawn["pending"] = like.new_zeros(len(seeds), steps, *action_shape)
    return drawn


def next_seeds(given: Sequence[int | None], before: Drawn | None, device: torch.device) -> Tensor:
    """Seeds (B,) of the next episodes: those given; else they follow from the episodes before, or are arbitrary."""
    seeds = to_device(np.array([-1 if each is None else each for each in given], np.int64), device)
    if before is None:
        others = to_device(np.array([secrets.randbits(62) for _ in given], np.int64), device)
    else:
        others = _bits(before["seed"], _NEXT, 0, 1)[:, 0] & (2**62 - 1)
    return torch.where(seeds < 0, others, seeds)


def start(drawn: Drawn, positions: Tensor, robot: int) -> Tensor:
    """Initial positions (B, N, 2), m, with the robot, the first particles, turned and shifted, but not lowered."""
    body = positions[:, :robot]
    x, y = (body - body.mean(1, keepdim=True)).unbind(-1)
    less, sin = drawn["turn"].cos()[:, None] - 1.0, drawn["turn"].sin()[:, None]
    # Differences, which are exactly 0 in an episode without a turn.
    moved = body + torch.stack((less * x - sin * y, sin * x + less * y), -1) + drawn["shift"][:, None]
    sunk = (body[..., 1].amin(1) - moved[..., 1].amin(1)).clamp_min(0.0)
    moved = moved + torch.stack((torch.zeros_like(sunk), sunk), 1)[:, None]
    return torch.cat((moved, positions[:, robot:]), 1)


def physics_of(conditions: Conditions, drawn: Drawn, spec: TaskSpec, physics: Physics, like: Tensor) -> Physics:
    """Constants of the matter with the factors of the episodes, for B simulations, B the length of ``like``."""
    changed = {}
    for name in conditions.changes(spec):
        value, factor = value_of(name, physics, spec, like), drawn[name]
        changed[name] = value * (factor if value.ndim == 1 else factor[:, None])
    return {**physics, **changed}


def extreme_physics(conditions: Conditions, end: int, spec: TaskSpec, physics: Physics, like: Tensor) -> Physics:
    """Constants of the matter with the smallest factors, ``end`` 0, or the largest, 1, for B simulations."""
    factors = {name: torch.full_like(like, conditions.bounds(name)[end]) for name in _FACTORS}
    return physics_of(conditions, factors, spec, physics, like)


def check_fit(conditions: Conditions, spec: TaskSpec, resolution: int) -> None:
    """Refuse a grid larger than that of the actions, and starts where a task has no room for the robot."""
    if conditions.grid is not None and conditions.grid > resolution:
        raise ValueError(f"conditions must have a grid of at most {resolution}, as actions have, got {conditions.grid}")
    if not (conditions.shift or conditions.turn):
        return
    # Steps of at most half the robot's width, so that it skips nothing that is in the way.
    steps = math.ceil(2.0 * conditions.shift / min(spec.robot.shape.size))
    largest = min(conditions.turn, 180.0)  # which is every direction
    turns = np.radians(np.linspace(-largest, largest, 2 * math.ceil(largest / TURN_STEP) + 1))
    shifts = np.linspace(-conditions.shift, conditions.shift, 2 * steps + 1)
    points = torch.from_numpy(probe(spec.robot))[None]
    for turn, *shift in itertools.product(turns, shifts, shifts):
        numbers = {"turn": points.new_tensor([turn]), "shift": points.new_tensor([shift])}
        moved = start(numbers, points, points.shape[1])[0].numpy()
        try:
            check_robot_at(spec, moved, moved.min(0), moved.max(0))
        except ValueError as error:
            ranges = f"shift={conditions.shift:g} and turn={conditions.turn:g}"
            raise ValueError(f"conditions must leave the robot room, got {ranges}, with which {error}") from error


def act(conditions: Conditions, drawn: Drawn, steps: Tensor, action: Tensor) -> tuple[Tensor, Drawn]:
    """What an action comes to: late, with noise, and without some of its entries.

    Args:
        conditions: Their ranges.
        drawn: Of the episodes.
        steps: (B,) control steps taken before this one.
        action: (B, 2, R, R).

    Returns:
        The action that is carried out, and what the episodes remember from here on.
    """
    seed = drawn["seed"]
    if conditions.bounds("latency")[1]:
        actions = torch.cat((action[:, None], drawn["pending"]), 1)
        action = actions[torch.arange(len(actions), device=actions.device), drawn["latency"]]
        drawn = {**drawn, "pending": actions[:, :-1]}
    size = action.shape[-1]
    grid = conditions.grid or size
    shape = (2, grid, grid)
    if conditions.bounds("action_noise")[1]:
        noise = _normal(seed, _NOISE, steps, math.prod(shape)).view(-1, *shape).to(action)
        noise = noise if grid == size else bicubic(noise, size)
        action = action + drawn["action_noise"][:, None, None, None] * noise
    if conditions.bounds("action_dropout")[1]:
        action = drop(action, _chosen(seed, _ACTION, steps, drawn["action_dropout"], shape))
    return action, drawn


def drop(values: Tensor, mask: Tensor) -> Tensor:
    """Set entries of (B, ..., A, A) to 0, selected by a bool mask (B, ..., R, R) whose entries cover whole cells."""
    if mask.shape != values.shape:
        size, grid = values.shape[-1], mask.shape[-1]
        cell = torch.arange(size, device=mask.device) * grid // size
        mask = mask[..., cell[:, None], cell]
    return values.masked_fill(mask, 0)


def seen(drawn: Drawn, steps: Tensor, image: Tensor) -> Tensor:
    """Images (B, 3, 64, 64) without some of their entries, after ``steps`` (B,) control steps."""
    return drop(image, _chosen(drawn["seed"], _PIXEL, steps, drawn["observation_dropout"], image.shape[1:]))
