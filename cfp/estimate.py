"""What a run will cost, by a few timed steps and updates of each stage in a temporary folder."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cfp.config import RunConfig
from cfp.environments import make_env
from cfp.process import StopSignals, peak_memory
from dittogym import make_spec

if TYPE_CHECKING:
    from cfp.command import Program

REPEATS = 3


@dataclass(frozen=True)
class Cost:
    """What one stage costs.

    Attributes:
        learning: Seconds of one environment step of one robot, its share of the updates included.
        held: Bytes that the stage will hold beyond what it holds as it begins (a replay memory).
    """

    learning: float
    held: int = 0


def seconds(action: Callable[[], object], repeats: int = REPEATS) -> float:
    """Mean duration of an action after a first, untimed time."""
    action()
    start = time.perf_counter()
    for _ in range(repeats):
        action()
    return (time.perf_counter() - start) / repeats


def estimate(program: Program, config: RunConfig) -> str:
    """Time and memory of a run as a table; no folder of the user's is touched.

    Raises:
        ConfigError: An option is wrong.
    """
    quiet = replace(config, report=replace(config.report, video=False, video_every=0, wandb="off"))
    with tempfile.TemporaryDirectory() as folder:
        run = program.run(quiet, Path(folder) / "run", False, StopSignals())
        costs, first = run.measure_all(), run.position.level
        others, remarks = run.unmeasured(), run.remarks()
    bounds, horizon, episodes = (0, *config.ends()), make_spec(config.task).horizon, config.report.eval_episodes
    lines = [f"{'stage':<8}{'action':>8}{'steps':>11}{'steps/s':>10}{'training':>11}{'evaluations':>13}{'replay':>10}"]
    total = 0.0
    for level, cost in enumerate(costs, first):
        size, steps = config.resolution(level), bounds[level + 1] - bounds[level]
        evaluation = _evaluation_step(config, level) * horizon
        count = 1 + steps // config.report.eval_every if config.report.eval_every else 0
        training, judging = steps * cost.learning, count * evaluation
        total += training + judging + evaluation  # its row of the final table
        lines.append(
            f"{level + 1:<8}{f'{size}x{size}':>8}{steps:>11,}{1 / cost.learning:>10.1f}{_duration(training):>11}"
            f"{_duration(judging):>13}{_size(cost.held):>10}"
        )
    memory = peak_memory()
    held = max(cost.held for cost in costs)
    lines.append(f"time: about {_duration(total)}, of {episodes} episodes to an evaluation that none ends early")
    lines.append("memory: " + (f"about {_size(memory + held)}" if memory else f"{_size(held)} and the program itself"))
    return "\n".join([*lines, *(f"not counted: {other}" for other in others), *remarks])


def _evaluation_step(config: RunConfig, level: int) -> float:
    """Seconds of one step of an evaluation's environments."""
    env = make_env(config, config.action_size(level), config.report.eval_episodes)
    env.reset()
    actions = np.stack([env.action_space.sample() for _ in range(env.num_envs)])
    return seconds(lambda: env.step(actions))


def _duration(value: float) -> str:
    hours, rest = divmod(round(value), 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s"


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
