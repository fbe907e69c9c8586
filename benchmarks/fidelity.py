"""Lite particles compared with full ones: returns under the same actions, and the ranking of random policies.

Run `python benchmarks/fidelity.py` for the table of returns, with `--policies 20` for rankings as well.
"""

import argparse
import math

import numpy as np
import torch
from scipy.stats import spearmanr

import dittogym

STEPS = 30
#: Steps of the episodes in which random policies are ranked.
RANKED = {"shapematch": 30, "obstacle": 150, "catch": 150, "run": 150, "kick": 100}


def wave(env: dittogym.TorchEnv, t: int) -> torch.Tensor:
    """The wave of the reference implementation's recorded episodes: along x in one muscle, along y in the other."""
    r, s = np.indices(env.action_shape[1:]) / env.action_resolution
    along, across = np.sin(2 * math.pi * (r + 0.15 * t)), np.cos(2 * math.pi * (s - 0.1 * t))
    return torch.as_tensor(np.stack((along, across)), dtype=env.dtype)[None]


def zeros(env: dittogym.TorchEnv, t: int) -> torch.Tensor:
    """No muscle acts."""
    return torch.zeros(1, *env.action_shape, dtype=env.dtype)


class RandomWaves:
    """An open-loop policy: for each muscle direction a wave of random amplitude, direction, length and period."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.amplitude, self.phase = rng.uniform(0.1, 1.0, 2), rng.uniform(0, 2 * math.pi, 2)
        self.frequency, self.waves = rng.uniform(-0.1, 0.1, 2), rng.uniform(-2.0, 2.0, (2, 2))

    def __call__(self, env: dittogym.TorchEnv, t: int) -> torch.Tensor:
        """Action (1, 2, R, R) at step t."""
        place = (np.indices(env.action_shape[1:]) + 0.5) / env.action_resolution
        turns = self.frequency[:, None, None] * t + np.einsum("ck,krs->crs", self.waves, place)
        wave = self.amplitude[:, None, None] * np.sin(2 * math.pi * turns + self.phase[:, None, None])
        return torch.as_tensor(wave, dtype=env.dtype)[None]


@torch.no_grad()
def rewards(task: str, particles: str, policy, steps: int, backend: str) -> tuple[np.ndarray, np.ndarray]:
    """Rewards and centres of mass until the episode ends."""
    env = dittogym.TorchEnv(task, particles=particles, action_layout="grid", backend=backend)
    env.reset(seed=0)
    gained, centres = [], []
    for t in range(steps):
        _, reward, terminated, _, info = env.step(policy(env, t))
        gained.append(float(reward))
        centres.append(info["com"][0].numpy())
        if terminated:
            break
    return np.array(gained), np.array(centres)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", type=int, default=0, help="random policies to rank in each of five tasks")
    parser.add_argument("--backend", default="auto", help="backend of the solver")
    arguments = parser.parse_args()
    print("| task | actions | return full | return lite | difference a step | centre of mass, at most (m) |")
    print("| --- " * 6 + "|")
    for task in dittogym.TASKS:
        for policy in (zeros, wave):
            (full, com), (lite, other) = (
                rewards(task, particles, policy, STEPS, arguments.backend) for particles in ("full", "lite")
            )
            both = min(len(full), len(lite))
            apart = np.abs(com[:both] - other[:both]).max()
            gap = (lite.sum() - full.sum()) / both
            row = (task, policy.__name__, f"{full.sum():.1f}", f"{lite.sum():.1f}", f"{gap:+.2f}", f"{apart:.4f}")
            print("| " + " | ".join(row) + " |", flush=True)
    for task, steps in RANKED.items() if arguments.policies else ():
        returns = np.array(
            [
                [rewards(task, name, RandomWaves(seed), steps, arguments.backend)[0].sum() for name in ("full", "lite")]
                for seed in range(arguments.policies)
            ]
        )
        spearman = spearmanr(*returns.T).statistic
        spread = returns[:, 0].min(), returns[:, 0].max()
        print(
            f"{task}: rank correlation {spearman:.3f} over {arguments.policies} policies, {steps} steps, "
            f"returns at full size {spread[0]:.1f} to {spread[1]:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
