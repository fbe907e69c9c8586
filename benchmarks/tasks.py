"""Cost of the environment steps of every task: `python benchmarks/tasks.py --out docs/task-costs.csv`.

Times are minima over rounds, of a step with random actions, its observation and reward, and of the same with the
gradient of the smooth reward with respect to the action. With one thread they are processor time, so that other
programs count less. Memory is what a gradient adds at its peak, after one with few particles that loads what gradients
need. Every row is measured in a process of its own (Linux).
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
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
    tasks: tuple[str, ...] = tuple(dittogym.TASKS)
    """Tasks."""
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


def memory(name: str) -> float:
    """Present (``"VmRSS"``) or peak (``"VmHWM"``) memory of this process, MiB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / 1024


def row(case: tuple[str, str], options: Options) -> dict[str, object]:
    """What a step of one robot costs."""
    task, particles = case
    torch.set_num_threads(options.threads)
    small, env = (dittogym.TorchEnv(task, particles=each) for each in (100, particles))
    for each in (small, env):
        each.reset(seed=0)
    action = torch.rand(1, *env.action_shape, generator=torch.Generator().manual_seed(0)) - 0.5

    def step() -> None:
        env.step(action)

    def gradient(env: dittogym.TorchEnv = env) -> None:
        leaf = action.clone().requires_grad_()
        env.step(leaf, soft=True)[1].sum().backward()
        env.detach()

    forward = milliseconds(step, options)
    gradient(small)
    gc.collect()
    before = memory("VmRSS")
    gradient()
    used = memory("VmHWM") - before
    return {
        "task": task,
        "particles": particles,
        "number": f"{env.num_particles:,}",
        "step, ms": f"{forward:.1f}",
        "with gradient, ms": f"{milliseconds(gradient, options):.1f}",
        "memory of the gradient, MiB": f"{used:.0f}",
    }


def main(options: Options) -> None:
    """Measure and write the table."""
    cases = [(task, particles) for task in options.tasks for particles in ("full", "lite")]
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        rows = pool.map(partial(row, options=options), cases, chunksize=1)
    write_text(options.out, csv_text(rows, list(rows[0])))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
