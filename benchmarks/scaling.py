"""Cost of a step by number of particles and of robots: `python benchmarks/scaling.py --out docs/scaling.csv`.

Times are minima over rounds, each of which measures every case once: a step of 100 substeps in the scene of RUN. With
one thread they are processor time, so that other programs count less.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib import pyplot
from test_solver import scene

from cfp.files import write_text
from cfp.tables import csv_text

SUBSTEPS = 100
ROBOTS = {
    "one robot": [(1, count) for count in (500, 2_000, 8_000, 22_000, 88_000, 200_000)],
    "robots of 2,000 particles": [(batch, 2_000) for batch in (1, 4, 16, 64, 256)],
}
MEASURES = {"forward": "forward", "gradient": "with gradient"}
Row = dict[str, float]


@dataclass(frozen=True)
class Options:
    """Measure steps, or draw the table of an earlier measurement."""

    out: Path
    """Table (CSV)."""
    picture: Path | None = None
    """Picture of the table."""
    draw_only: bool = False
    """Draw the table that --out names, and measure nothing."""
    backend: str = "auto"
    """Backend of the solver."""
    rounds: int = 8
    """Times that each case is measured, after once for warming up."""
    threads: int = 1
    """Number of threads."""


def prepare(backend: str, batch: int, count: int) -> tuple[Row, dict[str, Callable[[], object]]]:
    """The row of a case, and the two steps to measure."""
    solver, state, actuation, origin = scene(backend, batch, count)
    cotangent = torch.sin(40 * state.x)

    def forward(actuation: torch.Tensor = actuation) -> torch.Tensor:
        return solver.step(state, actuation, substeps=SUBSTEPS, origin=origin).x

    def gradient() -> None:
        leaf = actuation.clone().requires_grad_()
        torch.autograd.grad(forward(leaf), leaf, cotangent)

    return {"robots": batch, "particles": count}, {"forward": forward, "gradient": gradient}


def measure(options: Options) -> list[Row]:
    """Rows with nanoseconds a particle and substep."""
    torch.set_num_threads(options.threads)
    clock = time.process_time if options.threads == 1 else time.perf_counter
    cases = dict.fromkeys(case for cases in ROBOTS.values() for case in cases)
    prepared = [prepare(options.backend, *case) for case in cases]
    best: dict[tuple[int, str], float] = {}
    for number in range(options.rounds + 1):
        for case, (_, runs) in enumerate(prepared):
            for name, run in runs.items():
                start = clock()
                run()
                seconds = clock() - start
                if number:
                    best[case, name] = min(seconds, best.get((case, name), seconds))
    for case, (row, runs) in enumerate(prepared):
        for name in runs:
            row[f"{name} (ms/substep)"] = round(1e3 * best[case, name] / SUBSTEPS, 4)
            row[f"{name} (ns/particle)"] = round(
                1e9 * best[case, name] / SUBSTEPS / (row["robots"] * row["particles"]), 1
            )
    return [row for row, _ in prepared]


def draw(rows: list[Row], path: Path) -> None:
    """Draw time over the number of particles of all robots."""
    table = {(int(row["robots"]), int(row["particles"])): row for row in rows}
    figure, axes = pyplot.subplots(figsize=(5, 3.6), layout="constrained")
    for (label, cases), colour in zip(ROBOTS.items(), ("tab:blue", "tab:orange"), strict=True):
        totals = [batch * count for batch, count in cases]
        for (name, words), line in zip(MEASURES.items(), ("o-", "s--"), strict=True):
            costs = [table[case][f"{name} (ns/particle)"] for case in cases]
            axes.loglog(totals, costs, line, color=colour, label=f"{label}, {words}")
    axes.set(xlabel="particles of all robots", ylabel="ns per particle and substep", ylim=(1, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=150)


def main(options: Options) -> None:
    """Measure the table, and draw the picture."""
    if not options.draw_only:
        rows = measure(options)
        write_text(options.out, csv_text(rows, list(rows[0])))
    if options.picture is not None:
        with options.out.open(newline="") as file:
            draw([{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)], options.picture)


if __name__ == "__main__":
    main(tyro.cli(Options))
