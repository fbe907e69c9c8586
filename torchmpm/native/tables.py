"""A solver as the kernels see it: typed tables built once, and one table of its constants."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm.boundary import VelocityRule
from torchmpm.grid import PAD, Grid
from torchmpm.materials.base import Value, broadcast_plane
from torchmpm.materials.body import Body, slices
from torchmpm.materials.elastic import Elastic
from torchmpm.materials.snow import Snow
from torchmpm.materials.von_mises import STRETCH_FLOOR, VonMises, yield_surface
from torchmpm.substep import MASS_EPSILON

#: The materials that the kernels implement, in the order of ``enum class Kind``.
KINDS: tuple[type, ...] = (Elastic, VonMises, Snow)
#: Rows of the table of values, see ``struct Values`` in ``material.hpp``.
VALUES = 8


@dataclass(frozen=True)
class BodyTable:
    """The particles of one body.

    Attributes:
        first: Its first particle.
        count: Number of particles.
        kind: Index of its material in :data:`KINDS`.
        muscle: Whether the actuation acts on it.
        varying: Whether its values have one column per particle instead of one for all.
        column: Its first column in the table of values.
        hardening_low: Lower bound of the hardening factor (snow).
        hardening_high: Upper bound.
        shear_cutoff: Shear stretch below this is dropped (snow).
    """

    first: int
    count: int
    kind: int
    muscle: bool
    varying: bool
    column: int
    hardening_low: float = 1.0
    hardening_high: float = 1.0
    shear_cutoff: float = 0.0

    @property
    def columns(self) -> int:
        """Number of columns in the table of values."""
        return self.count if self.varying else 1


@dataclass(frozen=True)
class RuleTable:
    """One velocity rule.

    Attributes:
        axis: Component of the velocity that it acts on.
        sign: Sign of the removed velocity.
        i_low, i_high, j_low, j_high: Inclusive range of nodes.
        friction: Coulomb coefficient; infinite for a sticky rule.
        world: Whether the range counts nodes from the world's origin.
        slot: Rules against one direction share a slot, of which the first that covers a node applies; slots apply in
            their order.
    """

    axis: int
    sign: float
    i_low: float
    i_high: float
    j_low: float
    j_high: float
    friction: float
    world: bool
    slot: int


@dataclass(frozen=True)
class Tables:
    """All that is constant about a solver but its values; equal for solvers that differ in values only."""

    resolution: int
    h: float
    dt: float
    margin: float
    damping: float
    bodies: tuple[BodyTable, ...]
    rules: tuple[RuleTable, ...]
    mass_epsilon: float
    stretch_floor: float

    @property
    def width(self) -> int:
        """Nodes per axis with their padding."""
        return self.resolution + 2 * PAD

    @property
    def slots(self) -> int:
        """Number of directions that have velocity rules."""
        return len({rule.slot for rule in self.rules})


def make_tables(grid: Grid, bodies: Sequence[Body], rules: Sequence[VelocityRule], dt: float, damping: float) -> Tables:
    """Describe a solver.

    Args:
        grid: The window of nodes.
        bodies: The bodies, of materials in :data:`KINDS`.
        rules: The velocity rules.
        dt: Duration of a substep, s.
        damping: Factor on node velocities in a substep.
    """
    body_tables: list[BodyTable] = []
    column = 0
    for body, part in slices(bodies):
        kind, material = KINDS.index(type(body.material)), body.material
        snow = (*map(float, (*material.hardening_range, material.shear_cutoff)),) if isinstance(material, Snow) else ()
        table = BodyTable(part.start, body.count, kind, bool(body.muscle), _varying(body), column, *snow)
        body_tables.append(table)
        column += table.columns
    directions = list(dict.fromkeys(rule.direction for rule in rules))
    rule_tables = tuple(_rule_table(rule, directions.index(rule.direction)) for rule in rules)
    return Tables(
        resolution=grid.resolution,
        h=float(grid.h),
        dt=float(dt),
        margin=float(grid.margin),
        damping=float(damping),
        bodies=tuple(body_tables),
        rules=rule_tables,
        mass_epsilon=MASS_EPSILON,
        stretch_floor=STRETCH_FLOOR,
    )


def _varying(body: Body) -> bool:
    """Whether a constant of a body has one value per particle."""
    return any(
        isinstance(value, Tensor) and value.ndim == 2 and value.shape[1] > 1 for value in body.constants().values()
    )


def _rule_table(rule: VelocityRule, slot: int) -> RuleTable:
    lows = [-math.inf if low is None else float(low) for low, _ in (rule.i, rule.j)]
    highs = [math.inf if high is None else float(high) for _, high in (rule.i, rule.j)]
    axis, sign = "xy".index(rule.direction[1]), 1.0 if rule.direction[0] == "+" else -1.0
    world = rule.frame == "world"
    return RuleTable(axis, sign, lows[0], highs[0], lows[1], highs[1], float(rule.friction), world, slot)


_lock = threading.Lock()
_handles: dict[Tables, int] = {}
_by_handle: list[Tables] = []


def handle_of(tables: Tables) -> int:
    """A number that stands for tables in this process, because operators of torch take numbers and tensors only."""
    with _lock:
        if tables not in _handles:
            _handles[tables] = len(_by_handle)
            _by_handle.append(tables)
        return _handles[tables]


def tables_of(handle: int) -> Tables:
    """The tables that a handle stands for."""
    return _by_handle[handle]


def upload(numbers: Sequence[float], like: Tensor) -> Tensor:
    """Numbers as a tensor of the dtype and on the device of ``like``; does not wait for the device."""
    host = torch.tensor(numbers, dtype=like.dtype, device="cpu")
    return host.pin_memory().to(like.device, non_blocking=True) if like.is_cuda else host


def make_values(bodies: Sequence[Body], dt: float, h: float, like: Tensor) -> Tensor:
    """Material values, masses and volumes, with the graph of those that are tensors.

    A body whose values are the same for all its particles has one column, any other one column per particle.

    Args:
        bodies: The bodies.
        dt: Duration of a substep, s.
        h: Distance between nodes, m.
        like: (B, N) a plane of the state.

    Returns:
        (8, 1 or B, columns).
    """
    tables = []
    for body, part in slices(bodies):
        rows = _rows(body, -dt * (4.0 / h**2), like[:, part])
        if all(isinstance(row, (int, float)) for row in rows):
            tables.append(upload([float(row) for row in rows], like).view(VALUES, 1, 1))
        else:
            planes = [torch.as_tensor(row, dtype=like.dtype, device=like.device) for row in rows]
            planes = [plane.reshape(1, 1) if plane.ndim == 0 else plane for plane in planes]
            tables.append(torch.stack(torch.broadcast_tensors(*planes)))
    batch = max(table.shape[1] for table in tables)
    return torch.cat([table.expand(-1, batch, -1) for table in tables], dim=2).contiguous()


def _rows(body: Body, factor: float, like: Tensor) -> list[Value]:
    """The eight values of a body in the order of ``struct Values``.

    Computed in double precision, from tensors as from numbers: a value does not depend on the form in which it was
    given.
    """
    material = body.material
    assert isinstance(material, Elastic)
    wide = like.new_empty((), dtype=torch.float64).expand(like.shape)

    def value(name: str) -> Value:
        return broadcast_plane(getattr(material, name), wide, name)

    mu, lam = value("mu"), value("lam")
    stress_factor = factor * broadcast_plane(body.volume, wide, "volume")
    rows: list[Value] = [broadcast_plane(body.mass, wide, "mass"), stress_factor, 2.0 * mu, lam]
    if isinstance(material, VonMises):
        limit = value("yield_stress") / (2.0 * mu)
        if not isinstance(limit, Tensor):  # Python's exponential may differ from torch's in the last digit
            limit = torch.tensor(limit, dtype=torch.float64, device="cpu")
        tanh, exp, cosh2, sinh2 = yield_surface(limit)
        return [*rows, tanh * tanh, exp, cosh2, sinh2]
    if isinstance(material, Snow):
        return [*rows, 1.0 - value("compression"), 1.0 + value("stretch"), value("hardening"), 0.0]
    return [*rows, 0.0, 0.0, 0.0, 0.0]
