"""Speed of the kernels that came with an installed wheel beside that of kernels compiled on this machine.

`python wheel.py` prints environment steps of RUN, 4 x 2,000 particles, per second of processor time on one thread,
forward and with a gradient. Rounds take turns in processes of their own, and the fastest counts. It fails where the
installed package has no kernels for this processor, or where they are less than half as fast. Copy it out of the source
tree first, and have a compiler.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time

import torch

import dittogym
from torchmpm.native import library

KINDS, ROUNDS, ROBOTS, STEPS = ("wheel", "compiled"), 2, 4, 5


def measure(kind: str) -> tuple[float, float]:
    """Environment steps per second of processor time, of all robots together: forward, and with a gradient."""
    if kind == "compiled":
        library.packaged = lambda *_: None
    torch.set_num_threads(1)
    env = dittogym.TorchEnv("run", ROBOTS, particles="lite", backend="native")
    action = torch.zeros(ROBOTS, *env.action_shape)
    speeds = []
    for gradient in (False, True):
        action.requires_grad_(gradient)
        times = []
        for _ in range(1 + STEPS):  # the first one loads or compiles
            env.reset(seed=0)
            start = time.process_time()
            env.step(action)
            if gradient:
                env.state.x.sum().backward()
            times.append(time.process_time() - start)
        speeds.append(ROBOTS / min(times[1:]))
    return speeds[0], speeds[1]


def main() -> int:
    """Print the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=KINDS, help="measure these kernels alone, in this process")
    kind = parser.parse_args().kind
    if kind:
        print(*measure(kind))
        return 0
    came_from = library.provenance()
    print(f"{library.family()}: {came_from}")
    if came_from is None or isinstance(came_from, tuple):
        return 1
    best = dict.fromkeys(KINDS, (0.0, 0.0))
    for _ in range(ROUNDS):
        for kind in KINDS:
            command = [sys.executable, __file__, "--kind", kind]
            forward, gradient = subprocess.check_output(command, text=True).split()
            best[kind] = (max(best[kind][0], float(forward)), max(best[kind][1], float(gradient)))
    for name, wheel, compiled in zip(("forward", "gradient"), best["wheel"], best["compiled"], strict=True):
        print(f"{name}: wheel {wheel:.0f} steps/s, compiled here {compiled:.0f} steps/s, ratio {wheel / compiled:.2f}")
    return int(any(wheel < 0.5 * compiled for wheel, compiled in zip(*best.values(), strict=True)))


if __name__ == "__main__":
    sys.exit(main())
