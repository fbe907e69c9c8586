"""Substeps of 0.2 ms next to those of 0.1 ms, with lite particles: the tables of docs/concepts/fidelity.md.

Run `OMP_NUM_THREADS=1 python benchmarks/long_substeps.py --out docs` for `substeps-returns.csv` and
`substeps-gradients.csv`. The same episodes are played with both, from the same layouts of particles: a moving wave, the
pretrained policy of the task, and a planned episode, where only the planner's substeps differ. A task that refuses the
longer substep is left out.
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
from fidelity import wave
from torch import Tensor
from torch.nn.functional import cosine_similarity

import cfp
import dittogym
from baselines import GradientPlanner
from baselines.common.rollout import rollout
from baselines.planning.mpc import MPC
from cfp.files import write_text
from cfp.tables import csv_text
from dittogym.core import observe
from dittogym.spec import DT

LONG = 2 * DT
TASKS = list(dittogym.TASKS)
LAYOUTS, PLANNED_LAYOUTS = 6, 4
WAVE_STEPS, PLANNED_STEPS = 100, 64
WINDOW, WARMUP, ACTION_RANGE = 16, 8, 0.3

#: From observations (B, 3, 64, 64) and the step to actions (B, 2, R, R).
Act = Callable[[Tensor, int], Tensor]


@dataclass(frozen=True)
class Episode:
    """An episode from one layout of particles."""

    total: float  # return
    centres: np.ndarray  # (T, 2) centre of mass before each step, m


def make_envs(task: str, dt: float, count: int, **options: Any) -> list[dittogym.TorchEnv]:
    """The task with lite particles from several layouts, ``count`` in all.

    They are a batch; or where nothing is drawn at random, single robots of 2,000, 1,960, 1,920, ... particles.
    """
    options |= {"dt": dt}
    if any(body.shape.draws for body in dittogym.make_spec(task).bodies):
        envs = [dittogym.TorchEnv(task, count, particles="lite", **options)]
    else:
        envs = [dittogym.TorchEnv(task, particles=2000 - 40 * k, **options) for k in range(count)]
    for env in envs:
        env.reset(seed=0)
    return envs


@torch.no_grad()
def play(env: dittogym.TorchEnv, act: Act, steps: int) -> list[Episode]:
    """Play episodes side by side; what comes after an end does not count."""
    observation, running = observe(env.model, env.env_state), torch.ones(env.num_envs, dtype=torch.bool)
    returns, lengths, centres = torch.zeros(env.num_envs), torch.zeros(env.num_envs, dtype=torch.int64), []
    for step in range(min(steps, env.spec.horizon)):
        centres.append(env.env_state.centre.numpy())
        observation, reward, terminated, *_ = env.step(act(observation, step))
        returns, lengths = returns + reward * running, lengths + running
        running &= ~terminated
        if not running.any():
            break
    together = np.stack(centres, 1)
    return [Episode(float(returns[i]), together[i, : lengths[i]]) for i in range(env.num_envs)]


def rms(differences: np.ndarray) -> float:
    """Root mean square of numbers (K,) or of the lengths of vectors (K, 2)."""
    return float(np.sqrt(np.square(differences.reshape(len(differences), -1)).sum(1).mean()))


def millimetres(distance: float) -> str:
    """A distance in m as text; where robots fall apart, single particles fly away."""
    if distance > 1.0:
        return "torn"
    return f"{1e3 * distance:.2g}" if 1e-5 < distance < 0.1 else f"{1e3 * distance:.0f}"


def row(task: str, kind: str, short: list[Episode], long: list[Episode]) -> dict[str, object]:
    """How much the longer substep changes, and how much two initial positions differ; root mean squares."""
    last = [min(len(one.centres), len(other.centres)) - 1 for one, other in zip(short, long, strict=True)]
    totals = [np.array([episode.total for episode in episodes]) for episodes in (short, long)]
    centres = [np.array([e.centres[k] for e, k in zip(episodes, last, strict=True)]) for episodes in (short, long)]
    first, second = np.triu_indices(len(last), 1)
    return {
        "task": task,
        "episodes": kind,
        "steps": max(len(episode.centres) for episode in short),
        "return, 0.1 ms": f"{totals[0].mean():.0f}",
        "return, 0.2 ms": f"{totals[1].mean():.0f}",
        "changed by": f"{rms(totals[1] - totals[0]):.0f}",
        "between positions": f"{rms(totals[0][first] - totals[0][second]):.0f}",
        "centre of mass moved by (mm)": millimetres(rms(centres[1] - centres[0])),
        "between positions (mm)": millimetres(rms(centres[0][first] - centres[0][second])),
    }


def play_wave(task: str, dt: float) -> list[Episode]:
    """Episodes with the moving wave of the reference implementation's recorded episodes."""

    def episodes(env: dittogym.TorchEnv) -> list[Episode]:
        return play(env, lambda _, step: wave(env, step).expand(env.num_envs, -1, -1, -1), WAVE_STEPS)

    return [each for env in make_envs(task, dt, LAYOUTS, action_layout="grid") for each in episodes(env)]


def play_policy(task: str, dt: float) -> list[Episode]:
    """Whole episodes of the pretrained policy, without noise."""
    policy = cfp.load(task)
    envs = make_envs(task, dt, LAYOUTS, resolution=policy.resolution)
    return [each for env in envs for each in play(env, lambda seen, _: policy(seen, True), env.spec.horizon)]


def play_plan(task: str, dt: float) -> list[Episode]:
    """Episodes with substeps of 0.1 ms, planned by gradients with substeps of ``dt``."""
    config = MPC.preset(task, "quick")

    def episodes(env: dittogym.TorchEnv, model: dittogym.TorchEnv) -> list[Episode]:
        planner = GradientPlanner(model, config)

        def act(observation: Tensor, step: int) -> Tensor:
            model.env_state = env.env_state
            return planner.act()

        return play(env, act, PLANNED_STEPS)

    envs, models = (make_envs(task, each, PLANNED_LAYOUTS, resolution=config.resolution(1)) for each in (DT, dt))
    return [each for env, model in zip(envs, models, strict=True) for each in episodes(env, model)]


def window_gradients(short: dittogym.TorchEnv, long: dittogym.TorchEnv) -> list[Tensor]:
    """Gradients (B, T 2 R R) of a window's smooth return in its actions, from the same states with both substeps."""
    noise = torch.rand(WARMUP + WINDOW, 1, *short.action_shape, generator=torch.Generator().manual_seed(0))
    actions = (ACTION_RANGE * (2.0 * noise - 1.0)).repeat(1, short.num_envs, 1, 1, 1)
    with torch.no_grad():
        for action in actions[:WARMUP]:
            short.step(action)
    window = actions[WARMUP:].requires_grad_()
    totals = [rollout(env.model, short.env_state, window).rewards.sum() for env in (short, long)]
    return [torch.autograd.grad(total, window)[0].transpose(0, 1).flatten(1) for total in totals]


def gradients(task: str) -> dict[str, object]:
    """Angle and length of the gradients with the longer substeps, and how much those of two layouts differ."""
    envs = zip(*(make_envs(task, dt, LAYOUTS) for dt in (DT, LONG)), strict=True)
    short, long = (torch.cat(parts) for parts in zip(*(window_gradients(*pair) for pair in envs), strict=True))
    cosines, ratios = cosine_similarity(short, long), long.norm(dim=1) / short.norm(dim=1)
    others = torch.stack([cosine_similarity(*pair, dim=0) for pair in combinations(short, 2)])
    return {
        "task": task,
        "cosine": f"{cosines.mean():.3f}",
        "least cosine": f"{cosines.min():.3f}",
        "cosine between positions": f"{others.mean():.3f}",
        "ratio of norms": f"{ratios.min():.2f} to {ratios.max():.2f}",
        "norms between positions": f"{short.norm(dim=1).std() / short.norm(dim=1).mean():.0%}",
    }


def write(path: Path, rows: Sequence[dict[str, object]]) -> None:
    """Write rows into a table in the order of the tasks; rows of other tasks that it has already stay."""
    old: list[dict[str, object]] = []
    if path.exists():
        with path.open(newline="") as file:
            old = [*csv.DictReader(file)]
    written = {new["task"] for new in rows}
    kept = [each for each in old if each["task"] not in written]
    table = sorted([*kept, *rows], key=lambda each: TASKS.index(each["task"]))
    write_text(path, csv_text(table, list(table[0])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the two tables")
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    arguments = parser.parse_args()
    returns, slopes = [], []
    for task in arguments.tasks:
        try:
            dittogym.TorchEnv(task, particles="lite", dt=LONG)
        except ValueError as error:
            print(f"{task}: {error}", flush=True)
            continue
        for kind, function in (("wave", play_wave), ("policy", play_policy), ("plan", play_plan)):
            returns.append(row(task, kind, function(task, DT), function(task, LONG)))
            print(*returns[-1].values(), flush=True)
        slopes.append(gradients(task))
        print(*slopes[-1].values(), flush=True)
        write(arguments.out / "substeps-returns.csv", returns)
        write(arguments.out / "substeps-gradients.csv", slopes)


if __name__ == "__main__":
    main()
