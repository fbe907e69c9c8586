"""What kernels on CUDA need to know of a solver, unpacked from :func:`torchmpm.native.pack.description`."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm.grid import PAD
from torchmpm.material import LARGEST_JP
from torchmpm.native.pack import BODY_NUMBERS, HEAD, RULE_NUMBERS


@dataclass(frozen=True)
class BodyPart:
    """The particles of one body.

    Attributes:
        first: Its first particle.
        count: Number of particles.
        kind: Place of its material in :data:`torchmpm.native.pack.KINDS`.
        muscle: Whether the actuation acts on it.
        varying: Whether its values have one column per particle.
        column: Its first column in the table of values.
        bounds: Where its bounds stand among the constants.
    """

    first: int
    count: int
    kind: int
    muscle: bool
    varying: bool
    column: int
    bounds: int


@dataclass(frozen=True, eq=False)
class Tables:
    """Everything constant about a solver, on a device.

    Attributes:
        resolution: Nodes per axis.
        bodies: The bodies.
        slots: Number of directions that have velocity rules.
        constants: h, 1/h, dt, margin and extent of the window, damping, mass epsilon, stretch floor, largest Jp; then
            for each body the bounds of hardening and the shear cutoff.
        rules: (rules, 9) float64: the numbers of a rule in the description, and its slot. Slots apply in their order.
    """

    resolution: int
    bodies: tuple[BodyPart, ...]
    slots: int
    constants: Tensor
    rules: Tensor

    @property
    def width(self) -> int:
        """Nodes per axis with their padding."""
        return self.resolution + 2 * PAD


@functools.lru_cache(maxsize=64)
def unpack(description: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tables:
    """The tables of a description, remembered, because to copy them to a device waits for it."""
    resolution, h, dt, margin, damping, mass_epsilon, stretch_floor = description[:7]
    extent = resolution * h - margin
    constants = [h, 1.0 / h, dt, margin, extent, damping, mass_epsilon, stretch_floor, LARGEST_JP]
    constants += [0.0] * 3  # parts of a table begin at whole fours, as Triton compiles a kernel anew for others
    body_count, rule_count = int(description[7]), int(description[8])
    bodies, first = [], 0
    for start in range(HEAD, HEAD + BODY_NUMBERS * body_count, BODY_NUMBERS):
        count, kind, muscle, columns, column, *bounds = description[start : start + BODY_NUMBERS]
        part = BodyPart(first, int(count), int(kind), bool(muscle), columns > 1, int(column), len(constants))
        bodies.append(part)
        constants += [*bounds, 0.0]
        first += int(count)
    start = HEAD + BODY_NUMBERS * body_count
    rows: list[list[float]] = []
    slots: dict[tuple[float, ...], int] = {}
    for at in range(start, start + RULE_NUMBERS * rule_count, RULE_NUMBERS):
        rule = description[at : at + RULE_NUMBERS]
        rows.append([*rule, slots.setdefault(rule[:2], len(slots))])
    with torch.inference_mode(False):
        return Tables(
            resolution=int(resolution),
            bodies=tuple(bodies),
            slots=len(slots),
            constants=torch.tensor(constants, dtype=dtype, device=device),
            rules=torch.tensor(rows or [[0.0] * (RULE_NUMBERS + 1)], dtype=torch.float64, device=device),
        )
