"""Brings a solver into the tables of numbers that the kernels read."""

from __future__ import annotations

import functools
import importlib.util
import math
import os
import shutil
from collections.abc import Sequence
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from torchmpm.grid import Grid
from torchmpm.material import STRETCH_FLOOR, Elastic, Soil, Value, VonMises, column, yield_values

if TYPE_CHECKING:
    from torchmpm.solver import Body, Solver

#: The materials that the kernels know, in the order of ``enum class Kind``.
KINDS: tuple[type, ...] = (Elastic, VonMises, Soil)
#: Rows of the table of values, see ``struct Values`` in ``material.hpp``.
VALUES = 8
#: Tables of solvers whose values are all numbers, by dtype and device; they stay the same.
_numbers: WeakKeyDictionary[Solver, dict[tuple[torch.dtype, torch.device], tuple[Tensor, list[int]]]] = (
    WeakKeyDictionary()
)
#: Numbers of a description before those of the bodies, of each body, and of each rule.
HEAD, BODY_NUMBERS, RULE_NUMBERS = 9, 8, 8
#: A node remembers its rule in one byte.
MAX_RULES = 254
#: Numbers of a node, at most eight, and particles of one simulation have addresses of 32 bits within it. Those of all
#: simulations together have 64.
MAX_RESOLUTION, MAX_PARTICLES = 16_000, 2**30


def unsupported(solver: Solver, device: torch.device) -> str | None:
    """Why the kernels cannot run this solver on such a state, or ``None`` if they can."""
    if device.type not in ("cpu", "cuda"):
        return f"it runs on the CPU and on CUDA, the state is on {device}"
    if device.type == "cuda":
        missing = triton_lacks(os.environ.get("CC"), os.environ.get("PATH"))
        if missing is not None:
            return missing
        if torch.are_deterministic_algorithms_enabled() and not torch.is_deterministic_algorithms_warn_only_enabled():
            return "on CUDA its sums are taken in no fixed order, torch.use_deterministic_algorithms(True) forbids that"
    own = _overridden(solver)
    if own is not None:
        return f"it would go past {own}, which the substep calls"
    for body in solver.bodies:
        if type(body.material) not in KINDS:
            names = ", ".join(kind.__name__ for kind in KINDS)
            return f"it knows the materials {names}, a body has {type(body.material).__name__}"
    if len(solver.rules) > MAX_RULES:
        return f"it takes at most {MAX_RULES} velocity rules, got {len(solver.rules)}"
    if solver.grid.resolution > MAX_RESOLUTION:
        return f"it takes at most {MAX_RESOLUTION:,} nodes per axis, got {solver.grid.resolution:,}"
    if solver.num_particles > MAX_PARTICLES:
        return f"it takes at most {MAX_PARTICLES:,} particles a simulation, got {solver.num_particles:,}"
    return None


def _overridden(solver: Solver) -> str | None:
    """The first part of a substep that the type of a solver, or of its grid, has its own of, or ``None``."""
    from torchmpm.solver import Solver  # not at the top: the solver imports this module

    of_solver = ("scene", "substep", "to_grid", "_internal_force", "parts", "per_particle")
    for kind, known, names in (
        (type(solver), Solver, of_solver),
        (type(solver.grid), Grid, ("h", "width", "contains")),
    ):
        for name in names if kind is not known else ():
            if getattr(kind, name) is not getattr(known, name):
                return f"{kind.__name__}.{name}"
    return None


@functools.cache
def triton_lacks(compiler: str | None, path: str | None) -> str | None:
    """What keeps Triton from working, ``None`` if nothing does, with $CC and $PATH as given."""
    if importlib.util.find_spec("triton") is None:
        return "on CUDA it needs Triton, which is not installed (torch's builds for CUDA bring it along)"
    if compiler is None and not any(shutil.which(name, path=path) for name in ("gcc", "clang")):
        return "on CUDA it needs a C compiler for Triton ($CC, gcc or clang), found none"
    return None


def upload(numbers: Sequence[float], like: Tensor) -> Tensor:
    """Numbers as a tensor of the dtype and on the device of ``like``; does not wait for the device."""
    host = torch.tensor(numbers, dtype=like.dtype, device="cpu")
    return host.pin_memory().to(like.device, non_blocking=True) if like.is_cuda else host


def values(solver: Solver, like: Tensor) -> tuple[Tensor, list[int]]:
    """Material values, masses and volumes, with the graph of those that are tensors.

    A body whose values are the same for all its particles has one column, another one column per particle.

    Args:
        solver: The solver.
        like: (B, N) a plane of the state.

    Returns:
        The table, (8, 1 or B, columns), and how many of its columns belong to each body.
    """
    known = _numbers.get(solver, {}).get((like.dtype, like.device))
    if known is not None:
        return known
    tables, plain = [], True
    for body, part in solver.parts():
        rows = _rows(solver, body, like[:, part])
        plain = plain and not any(isinstance(value, Tensor) for value in (vars(body) | vars(body.material)).values())
        if all(isinstance(row, (int, float)) for row in rows):
            tables.append(upload([float(row) for row in rows], like).view(VALUES, 1, 1))
        else:
            planes = [torch.as_tensor(row, dtype=like.dtype, device=like.device) for row in rows]
            planes = [plane.reshape(1, 1) if plane.ndim == 0 else plane for plane in planes]
            tables.append(torch.stack(torch.broadcast_tensors(*planes)))
    batch = max(table.shape[1] for table in tables)
    widths = [table.shape[2] for table in tables]
    result = torch.cat([table.expand(-1, batch, -1) for table in tables], dim=2).contiguous(), widths
    if plain and type(result[0]) is Tensor:  # not one that only stands for a tensor while something is traced
        with torch.inference_mode(False):  # what is kept must serve gradients later
            result = result[0].clone(), widths
        _numbers.setdefault(solver, {})[like.dtype, like.device] = result
    return result


def _rows(solver: Solver, body: Body, like: Tensor) -> list[Value]:
    """The eight values of a body in the order of ``struct Values``.

    Of tensors in double precision, as of numbers: a value does not depend on the form in which it was given.
    """
    material = body.material
    assert isinstance(material, Elastic)
    wide = like.new_empty((), dtype=torch.float64).expand(like.shape)

    def value(name: str) -> Value:
        return column(getattr(material, name), wide, name)

    mu, lam = value("mu"), value("lam")
    factor = -solver.dt * (4.0 / solver.grid.h**2) * column(body.volume, wide, "volume")
    rows: list[Value] = [column(body.mass, wide, "mass"), factor, 2.0 * mu, lam]
    if isinstance(material, VonMises):
        limit = value("yield_stress") / (2.0 * mu)
        if not isinstance(limit, Tensor):  # Python's exponential may differ from torch's in the last digit
            limit = torch.tensor(limit, dtype=torch.float64, device="cpu")
        slope, *others = yield_values(limit)
        return [*rows, slope * slope, *others]
    if isinstance(material, Soil):
        return [*rows, 1.0 - value("compression"), 1.0 + value("stretch"), value("hardening"), 0.0]
    return [*rows, 0.0, 0.0, 0.0, 0.0]


def description(solver: Solver, widths: list[int], mass_epsilon: float) -> Tensor:
    """Everything else that is constant, as ``Scene::Scene`` in ``scene.hpp`` reads it.

    Args:
        solver: The solver.
        widths: Columns of each body in the table of :func:`values`.
        mass_epsilon: Added to the mass of a node before a division, kg.
    """
    grid = solver.grid
    numbers = [grid.resolution, grid.h, solver.dt, grid.margin, solver.damping, mass_epsilon, STRETCH_FLOOR]
    numbers += [len(solver.bodies), len(solver.rules)]
    first = 0
    for body, width in zip(solver.bodies, widths, strict=True):
        material = body.material
        low, high = material.hardening_range if isinstance(material, Soil) else (1.0, 1.0)
        cutoff = material.shear_cutoff if isinstance(material, Soil) else 0.0
        kind = KINDS.index(type(material))
        numbers += [body.count, kind, body.muscle, width, first, low, high, cutoff]
        first += width
    for rule in solver.rules:
        ends = [
            (-math.inf if low is None else low, math.inf if high is None else high) for low, high in (rule.i, rule.j)
        ]
        axis, sign = "xy".index(rule.direction[1]), 1.0 if rule.direction[0] == "+" else -1.0
        numbers += [axis, sign, *ends[0], *ends[1], rule.friction, rule.frame == "world"]
    return torch.tensor(numbers, dtype=torch.float64, device="cpu")


def body_widths(description: Tensor) -> list[tuple[int, int]]:
    """Particles and columns of each body, read back from :func:`description`."""
    head = description.tolist()
    end = HEAD + BODY_NUMBERS * int(head[HEAD - 2])
    return [(int(head[k]), int(head[k + 3])) for k in range(HEAD, end, BODY_NUMBERS)]
