"""Initial positions: particle counts, random or evenly spread particles, and whether bodies can start there."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dittogym.copies import to_device
from dittogym.geometry import contains
from dittogym.physics import real_tensor
from dittogym.spec import BodySpec, TaskSpec
from torchmpm import checks, sampling, tree
from torchmpm.sampling import Points

#: ``"full"``, ``"lite"``, the number of robot particles, or the numbers for robot and object.
Particles: TypeAlias = "str | int | tuple[int, ...]"

#: Seed of the first element, from which the others count on, or one for each; ``None``, alone or for one: not seeded.
Seed: TypeAlias = "int | Sequence[int | None] | np.ndarray | None"

#: Robot particles with ``particles="lite"``.
LITE = 2000
#: Points with which a shape is measured.
PROBE = 4096
#: Seeds of NumPy's legacy generator.
MAX_SEED = 2**32 - 1


def particle_counts(spec: TaskSpec, particles: Particles) -> tuple[int, ...]:
    """Particles of each body; a single number, or ``"lite"`` without ``BodySpec.lite``, keeps the full-size ratio."""
    full = tuple(body.count for body in spec.bodies)
    if isinstance(particles, str) and particles == "full":
        return full
    if isinstance(particles, str) and particles == "lite":
        count = spec.robot.lite or min(LITE, full[0])
        counts = (count, *(b.lite or max(1, round(count * b.count / full[0])) for b in spec.objects))
    elif isinstance(particles, (int, np.integer)) and not isinstance(particles, bool):
        count = checks.whole("particles", particles, 1)
        counts = (count, *(max(1, round(count * n / full[0])) for n in full[1:]))
    elif isinstance(particles, (tuple, list)) and len(particles) == len(full):
        counts = tuple(checks.whole(f"particles[{i}]", n, 1) for i, n in enumerate(particles))
    else:
        allowed = f"'full', 'lite', a number of robot particles, or a tuple of {len(full)}, one for each body"
        raise ValueError(f"particles must be {allowed}, got {particles!r}")
    return counts


def get_state(generator: np.random.RandomState) -> dict[str, Tensor]:
    """State of a Mersenne Twister: ``key`` (624,) and ``pos`` ()."""
    state = generator.get_state(legacy=False)["state"]
    return {"key": torch.from_numpy(state["key"].astype(np.int64)), "pos": torch.tensor(state["pos"], device="cpu")}


def set_state(generator: np.random.RandomState, state: Mapping[str, Tensor]) -> None:
    """Bring a generator to what :func:`get_state` returned."""
    key, pos = state["key"].numpy().astype(np.uint32), int(state["pos"])
    generator.set_state({"bit_generator": "MT19937", "state": {"key": key, "pos": pos}})


def body_positions(body: BodySpec, count: int, generator: np.random.RandomState, *, random: bool) -> Points:
    """Positions (N, 2) of ``count`` particles of a body, m.

    ``random`` positions are those that the reference implementation draws after ``numpy.random.seed(seed)``. With few
    particles they would leave holes in the body; a scrambled Sobol sequence does not.
    """
    if body.shape.draws == 0:
        numbers = np.empty((count, 2))
    elif random:
        numbers = generator.random_sample((count, body.shape.draws))
    else:
        numbers = sampling.sobol(count, seed=int(generator.randint(2**31)))
    if numbers.shape[1] == 4:  # magnitudes and signs
        numbers = 0.5 * (1.0 + np.where(numbers[:, 2:] > 0.5, 1.0, -1.0) * numbers[:, :2])
    return body.shape.positions(numbers)


@dataclass(frozen=True)
class InitialPositions:
    """Initial positions of a batch; a draw returns a new object, so that a reset that fails changes nothing.

    Attributes:
        spec: The task.
        counts: Particles of each body.
        num_envs: Number B of simulations.
        random: Random positions instead of evenly spread ones, see :func:`body_positions`.
        resample: Draw anew at every reset.
        generators: By element of the batch.
        positions: (B, N, 2) in the world, m; empty before the first draw.
        given: Whether a user gave some of them, so that conditions may move them out of the window.
    """

    spec: TaskSpec
    counts: tuple[int, ...]
    num_envs: int
    random: bool
    resample: bool
    generators: Mapping[int, np.random.RandomState] = field(default_factory=dict)
    positions: Tensor = field(default_factory=lambda: torch.empty(0))
    given: bool = False

    def draw(self, seed: Seed, mask: np.ndarray, given: Any, like: Tensor) -> InitialPositions:
        """The initial positions of the next episodes; elements outside ``mask`` (B,) keep theirs."""
        if seed is None and given is None and len(self.positions) and not self.resample:
            return self
        seeds, generators = self.seeds(seed), dict(self.generators)
        # Every element has positions from the first draw on.
        redrawn = mask.copy() if len(self.positions) else np.ones_like(mask)
        for i in np.flatnonzero(redrawn).tolist():
            if seeds[i] is not None or i not in generators:
                generators[i] = np.random.RandomState(seeds[i])
            elif self.resample:
                generators[i] = copy.deepcopy(generators[i])
            else:
                redrawn[i] = given is not None
        chosen = np.flatnonzero(redrawn)
        if given is not None:
            positions = self._given(given, like)
            self.check_inside(positions[torch.from_numpy(chosen)], chosen)
        elif len(chosen):
            stacked = np.zeros((self.num_envs, sum(self.counts), 2))
            bodies = tuple(zip(self.spec.bodies, self.counts, strict=True))
            for i in chosen.tolist():
                drawn = [body_positions(body, n, generators[i], random=self.random) for body, n in bodies]
                stacked[i] = np.concatenate(drawn)
            host = torch.from_numpy(stacked).to(like.dtype)
            self.check_inside(host[chosen], chosen)  # before it goes to a GPU, which would have to be waited for
            positions = to_device(host.numpy(), like.device)
        else:
            return self
        if len(self.positions):
            positions = tree.where(to_device(redrawn, like.device), positions, self.positions)
        some = given is not None or (self.given and not redrawn.all())
        return replace(self, generators=generators, positions=positions, given=some)

    def seeds(self, seed: Seed) -> Sequence[int | None]:
        """The seed of every element."""
        if seed is None:
            return [None] * self.num_envs
        seed = seed.tolist() if isinstance(seed, np.ndarray) and seed.ndim else seed
        if not isinstance(seed, (list, tuple, range)):
            first = checks.whole("seed", seed, 0, MAX_SEED + 1 - self.num_envs)
            return range(first, first + self.num_envs)
        if len(seed) != self.num_envs:
            raise ValueError(f"seed must be a whole number or {self.num_envs} of them, got {seed!r}")
        return [None if each is None else checks.whole(f"seed[{i}]", each, 0, MAX_SEED) for i, each in enumerate(seed)]

    def _given(self, given: Any, like: Tensor) -> Tensor:
        positions = real_tensor("positions", given).to(like, copy=True)
        shape = (sum(self.counts), 2)
        if tuple(positions.shape) not in (shape, (self.num_envs, *shape)):
            allowed = f"{shape} or {(self.num_envs, *shape)}"
            raise ValueError(f"positions must have shape {allowed}, got {tuple(positions.shape)}")
        return positions.expand(self.num_envs, *shape).contiguous()

    def check_inside(self, positions: Tensor, elements: np.ndarray) -> None:
        """Refuse positions (n, N, 2), m, of some elements (n,) that are not finite or outside the window."""
        if not bool((finite := torch.isfinite(positions)).all()):
            raise ValueError(f"positions must be finite, got {positions[~finite][0].item()}")
        origin = self.spec.window.origin(positions[:, : self.counts[0]].mean(1))
        inside = contains(positions, origin)
        if not bool(inside.all()):
            element, particle = (~inside).nonzero()[0].tolist()
            window = window_range(origin[element : element + 1])
            where = f"{positions[element, particle].tolist()} for particle {particle} of element {elements[element]}"
            raise ValueError(f"positions must lie inside the window ({window}), got {where}")


def probe(body: BodySpec) -> np.ndarray:
    """Points (n, 2), m, with which a body is measured.

    Raises:
        ValueError: Its shape returns other arrays, or points outside its bounding box.
    """
    points, who = body.shape.positions(sampling.sobol(PROBE, seed=0)), f"positions of {type(body.shape).__name__}"
    if np.shape(points) != (PROBE, 2):
        raise ValueError(f"{who} must return (N, 2) for N points, here N = {PROBE}, got {np.shape(points)}")
    low, high = _bounds(body)
    near = 1e-6  # m, more than single precision rounds
    if not ((points > low - near) & (points < high + near)).all():
        found = _box(points.min(0), points.max(0))
        raise ValueError(f"{who} must lie in the box of its corner and size, {_box(low, high)}, got {found}")
    return points


def check_place(spec: TaskSpec) -> None:
    """Refuse what cannot start where it is.

    Raises:
        ValueError: A body leaves the window or overlaps an obstacle, the robot reaches into the bounding box of the
            object or is torn from the start, or the goal lies outside a fixed window.
    """
    points = probe(spec.robot)
    origin = spec.window.origin(torch.from_numpy(points.mean(0, keepdims=True)))
    check_robot_at(spec, points, *_bounds(spec.robot))
    for index, other in enumerate(spec.objects):
        _check_free(spec, f"objects[{index}]", probe(other), *_bounds(other))
    split, limit = float(np.sqrt(points.var(0).sum())), spec.split_limit
    if limit is not None and split >= limit:
        raise ValueError(f"robot must be more compact: its spread is {split:.3f} m, and {spec.name} ends at {limit} m")
    if spec.goal is not None and not spec.window.moves and not bool(contains(origin.new_tensor([[spec.goal]]), origin)):
        raise ValueError(f"goal must lie inside the window ({window_range(origin)}), got {spec.goal}")


def check_robot_at(spec: TaskSpec, points: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Refuse a robot with these points (n, 2) and corners (2,) outside the window, in an obstacle, or at the object.

    A window that moves with the robot must not leave an object behind.
    """
    origin = spec.window.origin(torch.from_numpy(points.mean(0, keepdims=True)))
    for index, other in enumerate(spec.objects):
        _check_in_window(f"objects[{index}]", *_bounds(other), origin)
    _check_in_window("robot", low, high, origin)
    _check_free(spec, "robot", points, low, high)
    for other in spec.objects:
        first, last = _bounds(other)
        if _any_inside(points, first, last):
            place = _box(low, high)
            raise ValueError(f"robot must leave the place of the object free, {_box(first, last)}, got {place}")


def _bounds(body: BodySpec) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right corner (2,) of a body, m."""
    low = np.array(body.shape.corner)
    return low, low + body.shape.size


def _check_in_window(name: str, low: np.ndarray, high: np.ndarray, origin: torch.Tensor) -> None:
    if not bool(contains(torch.from_numpy(np.stack((low, high))[None]), origin).all()):
        raise ValueError(f"{name} must lie inside the window ({window_range(origin)}), got {_box(low, high)}")


def _check_free(spec: TaskSpec, name: str, points: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    for obstacle in spec.obstacles:
        for box in () if obstacle.rules == () else obstacle.boxes:
            if _any_inside(points, (box.left, box.bottom), (box.right, box.top)):
                solid = f"{box.left:.4g} < x < {box.right:.4g}, {box.bottom:.4g} < y < {box.top:.4g}"
                got = _box(low, high)
                raise ValueError(f"{name} must start outside the obstacle {obstacle.name!r} ({solid}), got {got}")


def _box(low: np.ndarray, high: np.ndarray) -> str:
    return f"{low[0]:.3f} < x < {high[0]:.3f}, {low[1]:.3f} < y < {high[1]:.3f}"


def window_range(origin: torch.Tensor) -> str:
    """What lies inside a window at ``origin`` (1, 2), m, for messages."""
    return f"{origin[0, 0]:.3f} < x < {origin[0, 0] + 1:.3f}, 0 < y < 1"


def _any_inside(points: np.ndarray, low: Sequence[float] | np.ndarray, high: Sequence[float] | np.ndarray) -> bool:
    x, y = points.T  # many times faster than a reduction over an axis of two
    return bool(((x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])).any())
