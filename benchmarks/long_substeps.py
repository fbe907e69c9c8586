"""Substeps of 0.2 ms next to those of 0.1 ms, at the lite tier: the tables of docs/concepts/fidelity.md.

Run `OMP_NUM_THREADS=1 python benchmarks/long_substeps.py --out docs` for `substeps-returns.csv` and
`substeps-gradients.csv`. The same episodes are played with both, from the same layouts of particles: a moving wave, the
pretrained policy of the task if there is one, and a planned episode, where only the planner's substeps differ. A task
that refuses the longer substep is left out.
"""

import argparse
import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tiers import sine
from torch import Tensor
from torch.nn.functional import cosine_similarity

import cfp
import dittogym
from baselines import GradientPlanner
from baselines.common.rollout import rollout
from baselines.planning.mpc import MPC
from cfp.weights import shipped
from dittogym.core import observe
from dittogym.spec import DT

LONG = 2 * DT
LAYOUTS, PLANNED_LAYOUTS = 6, 4
WAVE_STEPS, PLANNED_STEPS = 100, 64
WINDOW, WARMUP, ACTION_RANGE = 16, 8, 0.3

Act = Callable[[dittogym.TorchEnv, Tensor, int], Tensor]
"""From the environment, its observation and the step to actions (B, 2, R, R)."""


@dataclass(frozen=True)
class Episodes:
    """Episodes from several layouts, side by side."""

    returns: np.ndarray  # (B,)
    centres: np.ndarray  # (T, B, 2) centre of mass before each step, m
    lengths: np.ndarray  # (B,) steps until the end


def make_env(task: str, dt: float, count: int, **options: Any) -> dittogym.TorchEnv:
    """The task at the lite tier, at the start of episodes from the first layouts."""
    env = dittogym.TorchEnv(task, count, particles="lite", dt=dt, **options)
    env.reset(seed=0)
    return env


@torch.no_grad()
def play(env: dittogym.TorchEnv, act: Act, steps: int) -> Episodes:
    """Play episodes; what comes after an end does not count."""
    observation, running = observe(env.model, env.env_state), torch.ones(env.num_envs, dtype=torch.bool)
    returns, lengths, centres = torch.zeros(env.num_envs), torch.zeros(env.num_envs, dtype=torch.int64), []
    for step in range(min(steps, env.spec.horizon)):
        centres.append(env.env_state.centre.numpy())
        observation, reward, terminated, *_ = env.step(act(env, observation, step))
        returns, lengths = returns + reward * running, lengths + running
        running &= ~terminated
        if not running.any():
            break
    return Episodes(returns.numpy(), np.stack(centres), lengths.numpy())


def rms(differences: np.ndarray) -> float:
    """Root mean square of numbers (K,) or of the lengths of vectors (K, 2)."""
    return float(np.sqrt(np.square(differences.reshape(len(differences), -1)).sum(1).mean()))


def row(task: str, kind: str, short: Episodes, long: Episodes) -> dict[str, object]:
    """How much the longer substep changes, and how much two layouts differ; root mean squares."""
    last = np.minimum(short.lengths, long.lengths) - 1
    here, there = (each.centres[last, np.arange(len(last))] for each in (short, long))
    first, second = np.triu_indices(len(last), 1)
    return {
        "task": task,
        "episodes": kind,
        "steps": int(short.lengths.max()),
        "return, 0.1 ms": f"{short.returns.mean():.1f}",
        "return, 0.2 ms": f"{long.returns.mean():.1f}",
        "changed by": f"{rms(long.returns - short.returns):.1f}",
        "between layouts": f"{rms(short.returns[first] - short.returns[second]):.1f}",
        "centre of mass moved by (mm)": f"{1e3 * rms(there - here):.3g}",
        "between layouts (mm)": f"{1e3 * rms(here[first] - here[second]):.3g}",
    }


def wave(env: dittogym.TorchEnv, observation: Tensor, step: int) -> Tensor:
    """The wave of the recorded episodes of the reference implementation."""
    return sine(env, step).expand(env.num_envs, -1, -1, -1)


def play_wave(task: str, dt: float) -> Episodes:
    """Episodes with the moving wave."""
    return play(make_env(task, dt, LAYOUTS, action_layout="grid"), wave, WAVE_STEPS)


def play_policy(task: str, dt: float) -> Episodes:
    """Whole episodes of the pretrained policy, without noise."""
    policy = cfp.load(task)
    env = make_env(task, dt, LAYOUTS, resolution=policy.resolution)
    return play(env, lambda _, observation, step: policy(observation, deterministic=True), env.spec.horizon)


def play_plan(task: str, dt: float) -> Episodes:
    """Episodes with substeps of 0.1 ms, planned by gradients with substeps of ``dt``."""
    config = MPC.preset(task, "quick")
    env, model = (make_env(task, each, PLANNED_LAYOUTS, resolution=config.resolution(1)) for each in (DT, dt))
    planner = GradientPlanner(model, config.planner)

    def act(env: dittogym.TorchEnv, observation: Tensor, step: int) -> Tensor:
        model.env_state = env.env_state
        return planner.act()

    return play(env, act, PLANNED_STEPS)


def gradients(task: str) -> dict[str, object]:
    """The gradient of a window's smooth return in its actions, from the same states with both substeps."""
    short, long = (make_env(task, dt, LAYOUTS) for dt in (DT, LONG))
    shape = (WARMUP + WINDOW, 1, *short.action_shape)
    noise = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    actions = (ACTION_RANGE * (2.0 * noise - 1.0)).repeat(1, LAYOUTS, 1, 1, 1)
    with torch.no_grad():
        for action in actions[:WARMUP]:
            short.step(action)
    state, window, found = short.env_state, actions[WARMUP:].requires_grad_(), []
    for env in (short, long):
        total = rollout(env.model, state, window).rewards.sum()
        found.append(torch.autograd.grad(total, window)[0].transpose(0, 1).flatten(1))  # (B, T 2 R R)
    cosines, ratios = cosine_similarity(*found), found[1].norm(dim=1) / found[0].norm(dim=1)
    others = torch.stack([cosine_similarity(*pair, dim=0) for pair in combinations(found[0], 2)])
    return {
        "task": task,
        "cosine": f"{cosines.mean():.3f}",
        "least cosine": f"{cosines.min():.3f}",
        "cosine between layouts": f"{others.mean():.3f}",
        "ratio of norms": f"{ratios.min():.2f} to {ratios.max():.2f}",
        "norms between layouts": f"{found[0].norm(dim=1).std() / found[0].norm(dim=1).mean():.0%}",
    }


def write(path: Path, rows: Sequence[dict[str, object]]) -> None:
    """Write a table."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the two tables")
    parser.add_argument("--tasks", nargs="+", default=list(dittogym.TASKS), choices=list(dittogym.TASKS))
    arguments = parser.parse_args()
    returns, slopes = [], []
    for task in arguments.tasks:
        try:
            make_env(task, LONG, 1)
        except ValueError as error:
            print(f"{task}: {error}", flush=True)
            continue
        kinds = {"wave": play_wave} | ({"policy": play_policy} if task in shipped() else {}) | {"plan": play_plan}
        for kind, function in kinds.items():
            returns.append(row(task, kind, function(task, DT), function(task, LONG)))
            print(*returns[-1].values(), flush=True)
        slopes.append(gradients(task))
        print(*slopes[-1].values(), flush=True)
        write(arguments.out / "substeps-returns.csv", returns)
        write(arguments.out / "substeps-gradients.csv", slopes)


if __name__ == "__main__":
    main()
