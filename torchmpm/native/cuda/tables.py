"""The tables of :mod:`torchmpm.native.tables` on a CUDA device."""

import functools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmpm.materials.snow import LARGEST_JP
from torchmpm.native.tables import BodyTable, Tables


@dataclass(frozen=True, eq=False)
class DeviceTables:
    """Everything constant about a solver, on a device."""

    tables: Tables
    bodies: tuple[BodyTable, ...]
    slots: int  # number of directions that have velocity rules
    #: h, 1/h, dt, margin and extent of the window, damping, mass epsilon, stretch floor, largest Jp; then for each body
    #: the bounds of hardening, the shear cutoff and the resolved rate, from :meth:`bounds_of`.
    constants: Tensor
    rules: Tensor  # (rules, 9) float64: the numbers of each rule

    def bounds_of(self, body: int) -> Tensor:
        """The constants from the first one of a body."""
        return self.constants[12 + 4 * body :]


@functools.lru_cache(maxsize=64)
def device_tables(tables: Tables, dtype: torch.dtype, device: torch.device) -> DeviceTables:
    """The tables of a solver on a device; kept, because a copy to a device waits for it."""
    bodies = tables.bodies[: tables.num_bodies]
    rules = tables.rules[: tables.num_rules]
    constants = [tables.h, 1.0 / tables.h, tables.dt, tables.margin, tables.extent, tables.damping, tables.mass_epsilon]
    constants += [tables.stretch_floor, LARGEST_JP]
    constants += [0.0] * 3  # parts of a table begin at whole fours, as Triton compiles a kernel anew for others
    for body in bodies:
        constants += [body.hardening_low, body.hardening_high, body.shear_cutoff, body.resolved_rate]
    names = ("axis", "sign", "i_low", "i_high", "j_low", "j_high", "friction", "world", "slot")
    rows = [[float(getattr(rule, name)) for name in names] for rule in rules] or [[0.0] * len(names)]
    with torch.inference_mode(False):
        return DeviceTables(
            tables=tables,
            bodies=tuple(bodies),
            slots=len({rule.slot for rule in rules}),
            constants=torch.tensor(constants, dtype=dtype, device=device),
            rules=torch.tensor(rows, dtype=torch.float64, device=device),
        )
