"""Time and memory of a gradient through one step of RUN, as a table.

Run `python benchmarks/gradients.py`; each size runs in a process of its own, whose peak memory is measured (Linux).
"""

import argparse
import gc
import subprocess
import sys
import time
from pathlib import Path

import torch

import dittogym

SIZES = (22000, 2000)
REPEATS = 7


def resident(name: str) -> int:
    """Current (``"VmRSS"``) or peak (``"VmHWM"``) memory of this process in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(name))


def step(env: dittogym.TorchEnv, gradients: bool) -> float:
    """Seconds of one step; ``gradients`` adds a backward pass from the reward to the action."""
    action = torch.zeros(1, *env.action_shape, requires_grad=gradients)
    env.reset()
    begin = time.perf_counter()
    with torch.set_grad_enabled(gradients):
        reward = env.step(action)[1]
    if gradients:
        reward.sum().backward()
    env.detach()
    return time.perf_counter() - begin


def measure(count: int) -> None:
    """Print a row of the table."""
    env = dittogym.TorchEnv("run", particles=count, backend="native")
    env.reset(seed=0)
    substeps = env.model.substeps
    step(env, False)
    gc.collect()
    before = resident("VmRSS")
    step(env, True)
    used = resident("VmHWM") - before
    forward, both = (min(step(env, gradients) for _ in range(REPEATS)) for gradients in (False, True))
    times = f"{1e3 * forward / substeps:.3f} | {1e3 * both / substeps:.3f} | {both / forward:.1f}"
    print(f"| {count:,} | {times} | {used / 2**20:.0f} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, help="print the row of this size, measured in this process")
    particles = parser.parse_args().particles
    if particles:
        measure(particles)
        return
    print("| particles | forward, ms a substep | with backward | ratio | MiB |")
    print("| --- | --- | --- | --- | --- |", flush=True)
    for count in SIZES:
        subprocess.run([sys.executable, __file__, "--particles", str(count)], check=True)


if __name__ == "__main__":
    main()
