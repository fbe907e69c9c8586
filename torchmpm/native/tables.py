"""What the kernels read: a solver as typed tables built once, a table of its constants, and the tensors of a call."""

import ctypes
import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmpm.boundary import VelocityRule, limits
from torchmpm.grid import Grid
from torchmpm.materials.base import Value, broadcast_plane
from torchmpm.materials.body import Body, slices
from torchmpm.materials.elastic import Elastic
from torchmpm.materials.snow import Snow
from torchmpm.materials.von_mises import STRETCH_FLOOR, VonMises, yield_surface
from torchmpm.substep import MASS_EPSILON
from torchmpm.tree import cached_tensors

#: The materials that the kernels implement, in the order of ``enum class Kind``.
KINDS: tuple[type, ...] = (Elastic, VonMises, Snow)
#: Rows of the table of values, see ``struct Values`` in ``material.hpp``.
VALUES = 8
#: What the adjoint computes: derivatives in the tensors of :class:`Inputs`, see :meth:`Inputs.empty_cotangents`.
COTANGENTS = ("components_bar", "field_bar", "origin_bar", "gravity_bar", "values_bar")


def members(kind: Any, *names: str) -> list[tuple[str, Any]]:
    """Entries of ``_fields_`` for members of a ``ctypes.Structure`` that have one type."""
    return [(name, kind) for name in names]


class BodyTable(ctypes.Structure):
    """The particles of one body.

    ``first`` particle and ``count``; ``kind``, the index of its material in :data:`KINDS`; ``muscle``, whether the
    actuation acts on it; ``varying``, whether its values have one column per particle instead of one for all, and the
    first ``column``; for snow the bounds of the hardening factor, the cutoff of shear, and the rate ``1 / dt`` up to
    which derivatives follow its motion, infinite for exact ones.
    """

    _fields_ = [
        *members(ctypes.c_int64, "first", "count", "kind", "muscle", "varying", "column"),
        *members(ctypes.c_double, "hardening_low", "hardening_high", "shear_cutoff", "resolved_rate"),
    ]


class RuleTable(ctypes.Structure):
    """One velocity rule.

    It removes velocities along ``axis`` of one ``sign``, on an inclusive range of nodes, counted from the origin of the
    ``world`` or of the window; infinite ``friction`` sticks. Rules against one direction share a ``slot``, of which the
    first that covers a node applies; slots apply in their order.
    """

    _fields_ = [
        *members(ctypes.c_int64, "axis", "world", "slot"),
        *members(ctypes.c_double, "sign", "i_low", "i_high", "j_low", "j_high", "friction"),
    ]


class Tables(ctypes.Structure):
    """All that is constant about a solver but its values, as the C++ kernels read it (``scene.hpp``)."""

    _fields_ = [
        *members(ctypes.c_int64, "resolution", "num_bodies", "num_rules"),
        *members(ctypes.c_double, "h", "dt", "margin", "extent", "damping", "mass_epsilon", "stretch_floor"),
        ("bodies", ctypes.POINTER(BodyTable)),
        ("rules", ctypes.POINTER(RuleTable)),
    ]


class Inputs(NamedTuple):
    """Tensors of a call, all contiguous; a tree for ``torchmpm.tree``."""

    components: Tensor  # (13, B, N) components of the state, see ParticleState.components
    field: Tensor | None  # (B, 2, G, G) muscle actuation on the nodes, Pa
    origin: Tensor  # (B, 2) lower left corner of the window, m
    gravity: Tensor  # (B, 2) acceleration, m/s^2
    values: Tensor  # (8, 1 or B, columns) from make_values
    shift: Tensor  # (B, 2) int64, nodes between the world's origin and the window's
    result_bar: Tensor | None = None  # (13, B, N) derivative of a loss in the new components, for the adjoint

    def empty_cotangents(self, wants_field: bool, wants_values: bool) -> tuple[Tensor, ...]:
        """Memory for :data:`COTANGENTS`, in the shapes of components, field, origin and gravity.

        That of the values has the shape (8, B, N), a column for each particle. Those that are not wanted are empty.
        """
        components, field = self.components, self.field
        return (
            torch.empty_like(components),
            components.new_empty(field.shape if wants_field and field is not None else 0),
            torch.empty_like(self.origin),
            torch.empty_like(self.gravity),
            components.new_empty((VALUES, *components.shape[1:]) if wants_values else 0),
        )


def make_tables(grid: Grid, bodies: Sequence[Body], rules: Sequence[VelocityRule], dt: float, damping: float) -> Tables:
    """Describe a solver to the kernels."""
    directions = list(dict.fromkeys(rule.direction for rule in rules))
    rule_tables = (RuleTable * len(rules))(*(_rule_table(rule, directions.index(rule.direction)) for rule in rules))
    body_tables = (BodyTable * len(bodies))(*_body_tables(bodies, dt))
    sizes = (grid.resolution, len(bodies), len(rules))
    numbers = (grid.h, dt, grid.margin, grid.extent, damping, MASS_EPSILON, STRETCH_FLOOR)
    return Tables(*sizes, *numbers, body_tables, rule_tables)


def _body_tables(bodies: Sequence[Body], dt: float) -> Iterator[BodyTable]:
    column = 0
    for body, part in slices(bodies):
        material, varying = body.material, _varying(body)
        bounds = (1.0, 1.0, 0.0, math.inf)
        if isinstance(material, Snow):
            rate = math.inf if material.exact_gradients else 1.0 / dt
            bounds = (*material.hardening_range, material.shear_cutoff, rate)
        yield BodyTable(part.start, body.count, KINDS.index(type(material)), body.muscle, varying, column, *bounds)
        column += body.count if varying else 1


def _varying(body: Body) -> bool:
    """Whether a constant of a body has one value per particle."""
    return any(
        isinstance(value, Tensor) and value.ndim == 2 and value.shape[1] > 1 for value in body.constants().values()
    )


def _rule_table(rule: VelocityRule, slot: int) -> RuleTable:
    axis, sign = "xy".index(rule.direction[1]), 1.0 if rule.direction[0] == "+" else -1.0
    return RuleTable(axis, rule.frame == "world", slot, sign, *limits(rule.i), *limits(rule.j), rule.friction)


@cached_tensors
def upload(numbers: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Numbers as a tensor, which is kept; steps on any stream of the device may use it."""
    return torch.tensor(numbers, dtype=dtype, device=device)


def make_values(bodies: Sequence[Body], dt: float, h: float, like: Tensor) -> Tensor:
    """Material values, masses and volumes (8, 1 or B, columns), with the graph of those that are tensors.

    A body whose values are the same for all its particles has one column, any other one column per particle.
    """
    tables = []
    for body, part in slices(bodies):
        rows = _rows(body, -dt * (4.0 / h**2), like[:, part])
        if all(isinstance(row, (int, float)) for row in rows):
            tables.append(upload(tuple(float(row) for row in rows), like.dtype, like.device).view(VALUES, 1, 1))
        else:
            components = [_plane(row, like) for row in rows]
            tables.append(torch.stack(torch.broadcast_tensors(*components)))
    batch = max(table.shape[1] for table in tables)
    return torch.cat([table.expand(-1, batch, -1) for table in tables], dim=2).contiguous()


def _plane(row: Value, like: Tensor) -> Tensor:
    """A number, or a tensor, as a component that broadcasts against ``like`` (B, N)."""
    if isinstance(row, Tensor) and row.device == like.device:
        row = row.to(like)
        return row.reshape(1, 1) if row.ndim == 0 else row
    return like.new_full((1, 1), float(row))  # launches a kernel, where a copy would wait for the device


def _rows(body: Body, factor: float, like: Tensor) -> list[Value]:
    """The eight values of a body in the order of ``struct Values``, computed in double precision in any case."""
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
