"""Memory, speed and NaNs of long runs with random actions, as a CSV file.

`OMP_NUM_THREADS=1 python benchmarks/soak.py --out soak.csv` takes 100,000 environment steps of RUN with lite particles
in a batch of 16 and resets episodes that have ended. With `--endless --robots 1 --particles 20 --substeps 10000
--steps 86400` one episode lasts 24 hours of simulated time. Speed is given per second of processor time, which other
programs hardly affect.
"""

from __future__ import annotations

import itertools
import math
import os
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
import tyro

import dittogym  # noqa: F401  registers the environments
from cfp.config import Particles
from cfp.tables import CSVTable


@dataclass(frozen=True)
class Options:
    """What to run, and for how long."""

    out: Path
    """CSV file; rows are added."""
    task: str = "run"
    """Task, at its coarse resolution."""
    robots: int = 16
    """Simulations in the batch."""
    particles: Particles = "lite"
    """lite, full, or the number of the robot's particles."""
    substeps: int = 100
    """Physics steps of 0.1 ms in an environment step."""
    steps: int = 100_000
    """Steps of all robots together."""
    rows: int = 50
    """Rows of the table."""
    endless: bool = False
    """Never reset the environment: one single episode."""


def resident() -> float:
    """Memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main(options: Options) -> None:
    """Take all steps, and write a row at regular intervals."""
    env = gymnasium.make_vec(
        f"dittogym/{options.task}-coarse-v0",
        num_envs=options.robots,
        vectorization_mode="vector_entry_point",
        autoreset_mode="Disabled" if options.endless else "SameStep",
        particles=options.particles,
        substeps=options.substeps,
    )
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))  # compiles the kernels
    env.reset(seed=0)
    draw, table = np.random.default_rng(0), CSVTable(options.out)
    calls = math.ceil(options.steps / options.robots)
    ends = np.linspace(0, calls, min(options.rows, calls) + 1).astype(int)
    for first, last in itertools.pairwise(ends):
        episodes = failed = broken = 0
        start = time.process_time()
        for _ in range(first, last):
            action = draw.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32)
            _, rewards, terminated, truncated, info = env.step(action)
            episodes += 0 if options.endless else int((terminated | truncated).sum())
            failed += int(np.count_nonzero(info["reward_terms/failure"]))
            broken += int(np.count_nonzero(~np.isfinite(rewards)) + (~env.unwrapped.state.is_finite()).sum())
        seconds = time.process_time() - start
        row = {
            "step": int(last) * options.robots,
            "simulated (h)": f"{last * options.substeps * env.unwrapped.torch_env.model.solver.dt / 3600:.4g}",
            "steps/s": f"{(last - first) * options.robots / seconds:.4g}",
            "memory (MiB)": f"{resident():.1f}",
            "episodes ended": episodes,
            "failed": failed,
            "not finite": broken,
        }
        table.add(row)
        print(" ".join(f"{name} {value}" for name, value in row.items()), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
