"""Cost of a step by number of particles, batch size and threads, as a Markdown table.

Run ``python benchmarks/scaling.py [--backend native] [--rounds 8]``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
import tyro
from test_solver import scene

SUBSTEPS = 100
SIZES = ((1, 500), (1, 2_000), (1, 8_000), (1, 22_000), (1, 88_000), (4, 2_000), (16, 2_000), (64, 2_000), (256, 2_000))


@dataclass(frozen=True)
class Options:
    """Time steps of 100 substeps in the scene of RUN; the minimum over the rounds is printed."""

    backend: str = "auto"
    """Backend of the solver."""
    rounds: int = 8
    """Timed steps of each case, after one for warming up."""
    threads: tuple[int, ...] = tuple(sorted({1, torch.get_num_threads()}))
    """Numbers of threads."""


def seconds(run, rounds: int) -> float:
    """Minimum time of a call in seconds, after one for warming up."""
    run()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def main(options: Options) -> None:
    """Print the table."""
    print(
        "| simulations x particles | threads | forward, ms a substep | ns a particle | with gradient | ns a particle |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for batch, count in SIZES:
        solver, state, actuation, origin = scene(options.backend, batch, count)
        cotangent = torch.sin(40 * state.x)

        def forward(solver=solver, state=state, actuation=actuation, origin=origin) -> torch.Tensor:
            return solver.step(state, actuation, substeps=SUBSTEPS, origin=origin).x

        def gradient(actuation=actuation, cotangent=cotangent, forward=forward) -> None:
            with torch.enable_grad():
                torch.autograd.grad(forward(actuation=actuation.requires_grad_()), actuation, cotangent)

        for threads in options.threads:
            torch.set_num_threads(threads)
            with torch.no_grad():
                costs = [seconds(run, options.rounds) / SUBSTEPS for run in (forward, gradient)]
            cells = [f"{1e3 * cost:.3f} | {1e9 * cost / (batch * count):.1f}" for cost in costs]
            print(f"| {batch} x {count:,} | {threads} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
