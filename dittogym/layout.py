"""Particle counts and starting positions: fidelity tiers, random and evenly spread draws."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from dittogym.spec import Body, TaskSpec
from torchmpm import sampling
from torchmpm.sampling import Points

#: ``"full"``, ``"lite"``, the number of robot particles, or the numbers for robot and object.
Particles: TypeAlias = "str | int | tuple[int, ...]"

#: Robot particles of the lite tier.
LITE = 2000
#: Seeds of NumPy's legacy generator.
MAX_SEED = 2**32 - 1


def particle_counts(spec: TaskSpec, particles: Particles) -> tuple[int, ...]:
    """Particles of each body.

    ``"lite"`` and a single number keep the full-size ratio between the bodies.

    Raises:
        ValueError: Not one of the allowed forms, or a count below 1.
    """
    full = tuple(body.count for body in spec.bodies)
    if particles == "full":
        return full
    if particles == "lite":
        particles = LITE
    if isinstance(particles, (int, np.integer)) and not isinstance(particles, bool):
        counts = (int(particles), *(max(1, round(particles * n / full[0])) for n in full[1:]))
    elif isinstance(particles, (tuple, list)) and len(particles) == len(full):
        counts = tuple(int(n) for n in particles)
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
        if seed is not None and not 0 <= seed <= MAX_SEED:
            raise ValueError(f"seed must be between 0 and {MAX_SEED}, got {seed}")
        self._spec, self._counts, self._spread = spec, counts, spread
        self._generator = np.random.RandomState(seed)

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
