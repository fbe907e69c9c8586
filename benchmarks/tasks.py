"""Cost of the environment steps of every task: `python benchmarks/tasks.py --out docs/task-costs.csv`.

Times are minima over rounds, of a step with random actions, its observation and reward, and of the same with the
gradient of the smooth reward with respect to the action. With one thread they are processor time, so that other
programs count less.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import dittogym
from cfp.files import write_text
from cfp.tables import csv_text


@dataclass(frozen=True)
class Options:
    """Measure an environment step of every task, with full and with lite particles."""

    out: Path
    """Table (CSV)."""
    rounds: int = 20
    """Times that each step is measured, after once for warming up."""
    threads: int = 1
    """Number of threads."""


def milliseconds(function: Callable[[], object], options: Options) -> float:
    """Shortest time of a call."""
    clock = time.process_time if options.threads == 1 else time.perf_counter
    function()
    times = []
    for _ in range(options.rounds):
        start = clock()
        function()
        times.append(clock() - start)
    return 1e3 * min(times)


def row(task: str, particles: str, options: Options) -> dict[str, object]:
    """What a step of one robot costs."""
    env = dittogym.TorchEnv(task, particles=particles)
    env.reset(seed=0)
    action = torch.rand(1, *env.action_shape, generator=torch.Generator().manual_seed(0)) - 0.5

    def step() -> None:
        env.step(action)

    def gradient() -> None:
        leaf = action.clone().requires_grad_()
        env.step(leaf, soft=True)[1].sum().backward()
        env.detach()

    return {
        "task": task,
        "particles": particles,
        "number": f"{env.num_particles:,}",
        "step, ms": f"{milliseconds(step, options):.1f}",
        "with gradient, ms": f"{milliseconds(gradient, options):.1f}",
    }


def main(options: Options) -> None:
    """Measure and write the table."""
    torch.set_num_threads(options.threads)
    rows = [row(task, particles, options) for task in dittogym.TASKS for particles in ("full", "lite")]
    write_text(options.out, csv_text(rows, list(rows[0])))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
