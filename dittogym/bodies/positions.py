"""Particle counts and starting positions: fidelity tiers, random and evenly spread draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from dittogym.observation.window import window_origin
from dittogym.physics import real_tensor
from dittogym.spec import Body, TaskSpec
from torchmpm import Grid, checks, sampling, tree
from torchmpm.sampling import Points

#: ``"full"``, ``"lite"``, the number of robot particles, or the numbers for robot and object.
Particles: TypeAlias = "str | int | tuple[int, ...]"

#: Of the first element, the others count on from it; or one for each; ``None``, alone or in place of one: not seeded.
Seed: TypeAlias = "int | Sequence[int | None] | None"

#: Robot particles of the lite tier.
LITE = 2000
#: Seeds of NumPy's legacy generator.
MAX_SEED = 2**32 - 1


def particle_counts(spec: TaskSpec, particles: Particles) -> tuple[int, ...]:
    """Particles of each body.

    A single number keeps the full-size ratio between the bodies; so does ``"lite"``, unless a body of the task names
    its own number there.

    Raises:
        ValueError: Not one of the allowed forms, or a count below 1.
    """
    full = tuple(body.count for body in spec.bodies)
    if particles == "full":
        return full
    if particles == "lite":
        robot, *objects = spec.bodies
        count = min(LITE, robot.count)
        counts = (count, *(b.lite or max(1, round(count * b.count / robot.count)) for b in objects))
    elif isinstance(particles, (int, np.integer)) and not isinstance(particles, bool):
        counts = (int(particles), *(max(1, round(particles * n / full[0])) for n in full[1:]))
    elif isinstance(particles, (tuple, list)) and len(particles) == len(full):
        counts = tuple(checks.whole(f"particles[{i}]", n, 1) for i, n in enumerate(particles))
    else:
        shapes = " and ".join("robot" if i == 0 else "object" for i in range(len(full)))
        raise ValueError(
            f"particles must be 'full', 'lite', a number, or {len(full)} number(s) for {shapes}, got {particles!r}"
        )
    if min(counts) < 1:
        raise ValueError(f"particles must be at least 1 for every body, got {particles!r}")
    return counts


class LayoutSampler:
    """Draws the starting positions of one batch element; holds its random generator.

    At full size particles are thrown at random like in the reference implementation: the layout of seed s is the one
    that it draws after ``numpy.random.seed(s)``. With fewer particles random throws would leave holes in the body, so
    there the numbers come from a scrambled Sobol sequence.

    Args:
        spec: The task.
        counts: Particles of each body.
        seed: 0 to 2**32 - 1; ``None`` takes one from the operating system.
        spread: Evenly spread (Sobol) instead of random numbers.

    Raises:
        ValueError: The seed is out of range.
    """

    def __init__(self, spec: TaskSpec, counts: tuple[int, ...], seed: int | None, *, spread: bool) -> None:
        if seed is not None:
            checks.whole("seed", seed, 0, MAX_SEED)
        self._spec, self._counts, self._spread = spec, counts, spread
        self._generator = np.random.RandomState(seed)

    @property
    def generator(self) -> dict[str, Tensor]:
        """State of the generator; an assignment brings it back."""
        state = self._generator.get_state(legacy=False)["state"]
        return {"key": torch.from_numpy(state["key"].astype(np.int64)), "pos": torch.tensor(state["pos"], device="cpu")}

    @generator.setter
    def generator(self, state: Mapping[str, Tensor]) -> None:
        key, pos = state["key"].numpy().astype(np.uint32), int(state["pos"])
        self._generator.set_state({"bit_generator": "MT19937", "state": {"key": key, "pos": pos}})

    def draw(self) -> Points:
        """Positions (N, 2) in m, robot first; every call continues the generator's sequence."""
        return np.concatenate(
            [b.shape.positions(self._numbers(b, n)) for b, n in zip(self._spec.bodies, self._counts, strict=True)]
        )

    def _numbers(self, body: Body, count: int) -> Points:
        if body.shape.draws == 0:
            return np.empty((count, 2))
        if self._spread:
            return sampling.sobol(count, seed=int(self._generator.randint(2**31)))
        draws = self._generator.random_sample((count, body.shape.draws))
        if body.shape.draws == 2:
            return draws
        magnitude, sign = draws[:, :2], np.where(draws[:, 2:] > 0.5, 1.0, -1.0)
        return 0.5 * (1.0 + sign * magnitude)


class Layouts:
    """Starting positions of a batch: drawn at a seeded reset, kept until the next, or given by the user.

    Args:
        spec: The task.
        counts: Particles of each body.
        num_envs: Number B of simulations.
        spread: Evenly spread instead of random numbers, see :class:`LayoutSampler`.
        resample: Draw anew at every reset.
    """

    def __init__(self, spec: TaskSpec, counts: tuple[int, ...], num_envs: int, *, spread: bool, resample: bool) -> None:
        self._spec, self._counts, self._num_envs = spec, counts, num_envs
        self._spread, self._resample = spread, resample
        self._samplers: dict[int, LayoutSampler] = {}
        self._positions: Tensor | None = None

    @property
    def generators(self) -> dict[int, dict[str, Tensor]]:
        """States of the elements' generators, from which the next layouts are drawn; an assignment brings them back."""
        return {element: sampler.generator for element, sampler in self._samplers.items()}

    @generators.setter
    def generators(self, states: Mapping[int, Mapping[str, Tensor]]) -> None:
        for element, state in states.items():
            if element not in self._samplers:
                raise RuntimeError(f"call reset() first: element {element} has no random generator yet")
            self._samplers[element].generator = state

    def draw(self, seed: Seed, mask: np.ndarray, given: Any, like: Tensor) -> Tensor:
        """Starting positions (B, N, 2) in m of all elements; those outside ``mask`` (B,) keep theirs.

        Args:
            seed: Of the first element, the others follow, or one for each; ``None`` goes on with what there is, for
                all or for one.
            mask: Which elements are reset.
            given: (N, 2) or (B, N, 2) positions, or ``None``.
            like: Gives dtype and device.

        Raises:
            ValueError: Positions of the wrong shape or outside the window, or a seed out of range.
        """
        seeds = self._seeds(seed)
        samplers = dict(self._samplers)
        # Every element has a layout from the first draw on.
        mask = np.ones_like(mask) if self._positions is None else mask.copy()
        for i in np.flatnonzero(mask).tolist():
            if seeds[i] is not None or i not in samplers:
                samplers[i] = LayoutSampler(self._spec, self._counts, seeds[i], spread=self._spread)
            elif not self._resample:
                mask[i] = given is not None
        if given is not None:
            positions = self._given(given, like)
        elif mask.any():
            stacked = np.zeros((self._num_envs, sum(self._counts), 2))
            for i in np.flatnonzero(mask).tolist():
                stacked[i] = samplers[i].draw()
            positions = torch.from_numpy(stacked).to(like)
        else:
            assert self._positions is not None
            return self._positions.clone()
        if self._positions is not None:
            positions = tree.where(torch.as_tensor(mask, device=like.device), positions, self._positions)
        self._check_inside(positions)
        # Gradients in given positions reach back to this reset only, not to the one that uses them next.
        self._samplers, self._positions = samplers, positions.detach().clone()
        return positions

    def _seeds(self, seed: Seed) -> Sequence[int | None]:
        if seed is None:
            return [None] * self._num_envs
        if not isinstance(seed, (list, tuple, range)):
            first = checks.whole("seed", seed, 0, MAX_SEED + 1 - self._num_envs)
            return range(first, first + self._num_envs)
        if len(seed) != self._num_envs:
            raise ValueError(f"seed must be a whole number or {self._num_envs} of them, got {seed!r}")
        return [None if each is None else checks.whole(f"seed[{i}]", each, 0, MAX_SEED) for i, each in enumerate(seed)]

    def _given(self, given: Any, like: Tensor) -> Tensor:
        positions = real_tensor("positions", given).to(like, copy=True)
        shape = (sum(self._counts), 2)
        if tuple(positions.shape) not in (shape, (self._num_envs, *shape)):
            raise ValueError(
                f"positions must have shape {shape} or {(self._num_envs, *shape)}, got {tuple(positions.shape)}"
            )
        return positions.expand(self._num_envs, *shape).contiguous()

    def _check_inside(self, positions: Tensor) -> None:
        origin = window_origin(self._spec, positions[:, : self._counts[0]].mean(1))
        height = positions[..., 1] - origin[:, 1:2]
        inside = Grid().contains(positions[..., 0], origin[:, 0:1]) & (height > 0) & (height < 1)
        if not bool(inside.all()):
            element, particle = (~inside).nonzero()[0].tolist()
            where = positions[element, particle].tolist()
            raise ValueError(
                f"positions must lie inside the window ({origin[element, 0]:.3f} < x < {origin[element, 0] + 1:.3f}, "
                f"0 < y < 1), got {where} for particle {particle} of element {element}"
            )
