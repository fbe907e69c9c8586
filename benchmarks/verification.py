"""The solver against closed forms, and orders of convergence: `python benchmarks/verification.py --out table.csv`.

Each problem is a function with its own scene; `docs/concepts/verification.md` explains them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from torch import Tensor

from cfp.files import write_text
from cfp.tables import csv_text
from torchmpm import Body, Elastic, Grid, Material, ParticleState, Solver, VelocityRule, VonMises, diagnostics, fixed
from torchmpm.sampling import lattice

#: Large values, so that the 1e-10 kg that are added to every node are negligible.
MU, LAM, DENSITY = 5e6, 2e6, 2e4
#: Resistance to stretching in one direction alone, Pa.
MODULUS = LAM + 2 * MU
SPEED = math.sqrt(MODULUS / DENSITY)
GEL = Elastic(MU, LAM)
FALL = (0.7, -2.0)


class Result(NamedTuple):
    """What a problem's solution is, and what was found."""

    exact: float
    measured: float

    @property
    def error(self) -> float:
        """Difference, relative to the exact value unless that is zero."""
        return abs(self.measured - self.exact) / (abs(self.exact) or 1.0)


def block(
    cells: tuple[int, int], corner: tuple[float, float], size: tuple[float, float], material: Material = GEL
) -> tuple[Body, ParticleState]:
    """A box of matter of :data:`DENSITY` on a lattice of particles."""
    count, area = cells[0] * cells[1], size[0] * size[1]
    x = torch.from_numpy(lattice(cells, corner, size))
    body = Body(count, material, mass=DENSITY * area / count, volume=area / count)
    return body, ParticleState.at_rest(x)


def free_fall(dt: float, backend: str = "auto") -> Result:
    """Height lost in 0.2 s."""
    body, state = block((8, 8), (0.4, 0.6), (0.125, 0.125))
    solver = Solver(Grid(16), (body,), gravity=FALL, dt=dt, backend=backend)
    final = solver.step(state, substeps=round(0.2 / dt))
    return Result(0.5 * FALL[1] * 0.2**2, (final.x - state.x)[0, :, 1].mean().item())


def oscillation(dt: float, backend: str = "auto") -> Result:
    """Strain of a particle alone after 16 ms, about two of its own small oscillations, relative to that at the start.

    Its nodes give ``C' = -4/h^2 V/m tau`` for it, so that a change of volume swings with ``omega = 2 c / h`` where
    ``c^2 = 2 (mu + lam) / density``.
    """
    grid, strain, duration = Grid(16), 1e-6, 0.016
    body, state = block((1, 1), (0.51, 0.52), (0.06, 0.06))
    solver = Solver(grid, (body,), dt=dt, backend=backend)
    omega = 2.0 / grid.h * math.sqrt(2 * (MU + LAM) / DENSITY)
    final = solver.step(replace(state, F=(1.0 + strain) * state.F), substeps=round(duration / dt))
    return Result(math.cos(omega * duration), (final.F[0, 0, 0, 0].item() - 1.0) / strain)


class Pulse(NamedTuple):
    """What became of a wave."""

    speed: Result  #: m/s
    height: Result  #: relative to that at the start
    shape: Result  #: distance from what it should be, relative to its size


def pulse(cells: int, courant: float = 0.25, backend: str = "auto") -> Pulse:
    """A small compression runs to the right, through half of a bar that can only move along its length.

    It is a Gaussian of 1/8 of the bar's length; the bar is ``cells`` long, and sound crosses the share ``courant`` of a
    cell in a substep. The exact solution is d'Alembert's: it does not change.
    """
    grid, size = Grid(cells + 16), 1e-6
    length, left = cells * grid.h, 8 * grid.h
    body, state = block((2 * cells, 2), (left, left), (length, grid.h))
    substeps = round(0.5 * cells / courant)
    dt = 0.5 * length / SPEED / substeps
    rules = (VelocityRule("+y"), VelocityRule("-y"))
    solver = Solver(grid, (body,), rules=rules, dt=dt, backend=backend)

    def wave(x: Tensor, start: float) -> Tensor:
        return torch.exp(-(((x - left) / length - start) ** 2) * 256.0)

    x = state.x[..., 0]
    speed = size * SPEED * wave(x, 0.25)
    F = state.F.clone()
    F[..., 0, 0] -= speed / SPEED
    final = solver.step(replace(state, F=F, v=torch.stack((speed, 0 * speed), -1)), substeps=substeps)
    v = final.v[..., 0]
    way = ((v * x).sum() / v.sum() - (speed * x).sum() / speed.sum()).item()
    expected = size * SPEED * wave(x, 0.75)
    return Pulse(
        Result(SPEED, way / (substeps * dt)),
        Result(1.0, (v.max() / expected.max()).item()),
        Result(0.0, ((v - expected).norm() / expected.norm()).item()),
    )


def traction(stretch: float, backend: str = "auto") -> Result:
    """Stress in a bar that is stretched evenly and held at its left end, from the impulse on the nodes that hold it."""
    grid = Grid(32)
    height, corner = 4 * grid.h, (8 * grid.h, 8 * grid.h)
    body, state = block((24, 8), corner, (12 * grid.h, height))
    stretched = torch.diag(torch.tensor([stretch, 1.0], dtype=torch.float64))
    state = replace(state, F=stretched.expand_as(state.F))
    body = replace(body, volume=body.volume / stretch)
    solver = Solver(grid, (body,), rules=fixed(i=(None, 13)), backend=backend)
    impulse = diagnostics.impulses(solver, state)["boundary"][0, 0].item()
    after = diagnostics.momentum(solver, solver.step(state))[0, 0].item()
    assert math.isclose(after, impulse, rel_tol=1e-6, abs_tol=1e-12), "the bar gains what the nodes give"
    return Result(MODULUS * (stretch - 1.0), -impulse / (solver.dt * height))


def plastic_flow(stretch: float, backend: str = "auto") -> Result:
    """Elastic divided by total change of area of a plastic block that has been stretched to this ratio of its sides.

    The total deformation is integrated from the velocity gradients.
    """
    grid, rate = Grid(32), 25.0
    body, state = block((32, 32), (0.375, 0.375), (0.25, 0.25), VonMises(MU, LAM, yield_stress=1e4))
    shear = torch.tensor([[rate, 0.0], [0.0, -rate]], dtype=torch.float64)
    state = replace(state, v=(state.x - 0.5) @ shear.T, C=shear.expand_as(state.C))
    solver = Solver(grid, (body,), backend=backend)
    whole, identity = state.F, torch.eye(2, dtype=torch.float64)
    while drawn_out(whole) < stretch:
        whole = (identity + solver.dt * state.C) @ whole
        state = solver.step(state)
    assert drawn_out(state.F) < 1.01, "what is elastic is small"
    ratio = torch.linalg.det(state.F) / torch.linalg.det(whole)
    worst = (ratio - 1.0).abs().argmax()
    return Result(1.0, ratio.flatten()[worst].item())


def drawn_out(F: Tensor) -> float:
    """Mean ratio of the principal stretches."""
    large, small = torch.linalg.svdvals(F).unbind(-1)
    return (large / small).mean().item()


def settling(cells: int, backend: str = "auto") -> tuple[Result, Result]:
    """A column of gel between smooth walls at rest under its own weight: how far its middle sinks.

    Stress grows linearly with the weight above, and the stretch of this gel linearly with the stress:
    ``s(Y) = 1 - rho g (H - Y) / M`` at the height Y before, up to any load.

    Returns:
        Mean displacement, and the error of the stretch (root of the mean square, without two cells at both ends),
        relative to the largest compression.
    """
    grid, pull = Grid(2 * cells), 60.0
    floor, height = 4, cells * grid.h
    body, state = block((8, 2 * cells), (8 * grid.h, floor * grid.h), (4 * grid.h, height))
    rules = (*fixed(j=(None, floor)), VelocityRule("+x"), VelocityRule("-x"))
    dt = 0.2 * grid.h / SPEED
    # Damped to rest within a few swings.
    solver = Solver(grid, (body,), gravity=(0.0, -pull), damping=1.0 - 4 * dt * SPEED / height, rules=rules, dt=dt)
    solver = replace(solver, backend=backend)
    final = solver.step(state, substeps=round(12 * height / SPEED / dt))
    Y = state.x[..., 1] - floor * grid.h
    load = DENSITY * pull / MODULUS
    stretch = 1.0 - load * (height - Y)
    sunk = -load * (height * Y - 0.5 * Y**2)
    inner = (Y > 2 * grid.h) & (Y < height - 2 * grid.h)
    error = (final.F[..., 1, 1] - stretch)[inner].square().mean().sqrt().item() / (load * height)
    return Result(sunk.mean().item(), (final.x - state.x)[..., 1].mean().item()), Result(0.0, error)


def orders(sizes: Sequence[float], errors: Sequence[float]) -> list[float]:
    """Slope of the error from size to size in a doubly logarithmic plot."""
    pairs = zip(itertools.pairwise(sizes), itertools.pairwise(errors), strict=True)
    return [math.log(e / f) / math.log(s / t) for (s, t), (e, f) in pairs]


@dataclass(frozen=True)
class Options:
    """Solve all problems in double precision and write a table."""

    out: Path
    """CSV file."""
    backend: str = "auto"
    """Of the solver."""


def series(problem: str, unit: str, sizes: Sequence[float], results: Sequence[Result]) -> list[dict[str, str]]:
    """Rows of one problem, with the order of convergence where its size halves or doubles from row to row."""
    slopes = [math.nan]
    if len(sizes) > 1:
        slopes += orders(sizes, [result.error for result in results])
    return [
        {
            "problem": problem,
            "size": f"{size:g} {unit}",
            "exact": f"{result.exact:.6g}",
            "measured": f"{result.measured:.6g}",
            "error": f"{result.error:.1e}",
            "order": "" if math.isnan(slope) else f"{abs(slope):.2f}",
        }
        for size, result, slope in zip(sizes, results, slopes, strict=True)
    ]


def table(backend: str) -> Iterator[dict[str, str]]:
    """Rows of the table."""
    steps = (2e-3, 1e-3, 5e-4, 2.5e-4)
    yield from series("free fall (m)", "s", steps, [free_fall(dt, backend) for dt in steps])
    steps = (8e-5, 4e-5, 2e-5, 1e-5)
    yield from series("oscillation of a particle", "s", steps, [oscillation(dt, backend) for dt in steps])
    cells = (32, 64, 128, 256)
    pulses = [pulse(n, backend=backend) for n in cells]
    yield from series("wave: speed (m/s)", "cells", cells, [p.speed for p in pulses])
    yield from series("wave: shape", "cells", cells, [p.shape for p in pulses])
    for courant in (0.8, 0.2, 0.05):
        yield from series(
            "wave over 64 cells: height", "cell a substep", [courant], [pulse(64, courant, backend).height]
        )
    for stretch in (0.6, 0.9, 1.1, 1.6):
        yield from series("stress of a bar (Pa)", "stretch", [stretch], [traction(stretch, backend)])
    yield from series("area in plastic flow", "ratio of sides", [2.0], [plastic_flow(2.0, backend)])
    cells = (16, 32, 64)
    columns = [settling(n, backend) for n in cells]
    yield from series("column under its weight: middle (m)", "cells", cells, [c[0] for c in columns])
    yield from series("column under its weight: stretch", "cells", cells, [c[1] for c in columns])


def main(options: Options) -> None:
    """Print the rows, and write them."""
    rows = []
    for row in table(options.backend):
        rows.append(row)
        print(" | ".join(str(cell) for cell in row.values()), flush=True)
    write_text(options.out, csv_text(rows, list(rows[0])))


if __name__ == "__main__":
    main(tyro.cli(Options))
