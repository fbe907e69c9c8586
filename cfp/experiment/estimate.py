"""What a run will cost, by a few timed steps and updates of each stage in a temporary folder."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import RunConfig
from cfp.envs.make import make_env
from cfp.evaluation.rollout import ZeroPolicy, attached
from cfp.evaluation.video import available
from cfp.experiment.process import StopSignals, peak_memory
from cfp.experiment.state_file import Position, StateFile
from dittogym import make_spec

if TYPE_CHECKING:
    from cfp.experiment.cli import Program
    from cfp.experiment.run import Run

REPEATS = 3
COLUMNS = {"stage": 5, "action": 7, "steps": 11, "steps/s": 8, "training": 11, "evaluations": 11, "replay": 8}
"""Of the table, and their widths."""


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


def estimate(program: Program, config: RunConfig, begun: Path | None = None) -> str:
    """Time and memory of a run as a table; no folder of the user's is touched.

    Args:
        program: Knows how to open it.
        config: Its options.
        begun: Folder of the run if it goes on: then only what its checkpoint leaves is counted.

    Raises:
        ConfigError: An option is wrong.
        CheckpointError: The checkpoint is damaged.
    """
    quiet = replace(config, report=replace(config.report, video=False, video_every=0, wandb="off"))
    bounds, report, rows, total = (0, *config.ends()), config.report, [_row(COLUMNS)], 0.0
    with tempfile.TemporaryDirectory() as folder:
        run = program.run(quiet, Path(folder) / "run", False, StopSignals())
        costs, first = run.measure_all(), run.position.level
        lines = [f"not counted: {other}" for other in run.unmeasured()]
        done = bounds[first]
        if begun is not None and (checkpoint := StateFile(begun / "checkpoint")).exists():
            state = checkpoint.load()
            run.position, lines = Position(state["level"], state["offset"]), []
            done = state["offset"] + state["model"]["num_timesteps"]
            rows.insert(0, f"{begun} is at step {done:,} of {bounds[-1]:,}; what is left of it:")
        for level, cost in enumerate(costs, first):
            if level < run.position.level:
                continue
            start, end = max(bounds[level], done), max(bounds[level + 1], done)
            policy, size = run.load(run.folder / f"stage{level + 1}.safetensors"), config.action_size(level)
            judged = partial(_episodes, config, policy, size)
            count = 0
            if report.eval_every and end > start:
                fresh = start == bounds[level] and run.begins_trained(level)
                count = -(-end // report.eval_every) - start // report.eval_every + fresh
            films = end // report.video_every - start // report.video_every if report.video_every else 0
            training = (end - start) * cost.learning
            judging = count * judged(config.evaluation(level)[1]) if count else 0.0
            filming = films * judged(1, film=True) if films and available() else 0.0
            total += training + judging + filming
            grid = config.resolution(level)
            speed = f"{1 / cost.learning:.1f}"
            spent = _duration(training), _duration(judging + filming)
            rows.append(_row((f"{level + 1}", f"{grid}x{grid}", f"{end - start:,}", speed, *spent, _size(cost.held))))
        ending = _ending(run, config)
        lines += run.remarks()
    memory, held = peak_memory(), max(cost.held for cost in costs)
    rows.append(
        f"time: about {_duration(total + ending)}, {_duration(ending)} of it for what follows the training; "
        f"of {report.eval_episodes} episodes to an evaluation that none ends early"
    )
    rows.append("memory: " + (f"about {_size(memory + held)}" if memory else f"{_size(held)} and the program itself"))
    return "\n".join([*rows, *lines])


def _ending(run: Run, config: RunConfig) -> float:
    """Seconds of the final table and the film."""
    size, episodes = config.resolution(0), config.report.eval_episodes
    spent = 2 * _episodes(config, ZeroPolicy(size), size, episodes)  # at rest and at random
    policies = list(run.policies().values())
    for policy in policies:
        judged = partial(_episodes, config, policy, policy.resolution)
        spent += judged(episodes) + (judged(1) if "layout" in policy.description else 0.0)
    if config.report.video and available():
        spent += _episodes(config, policies[-1], policies[-1].resolution, 1, film=True)
    return spent


def _episodes(config: RunConfig, policy: PolicyPredictor, size: int, count: int, film: bool = False) -> float:
    """Seconds of some episodes side by side that none ends early."""
    env = make_env(config, size, count)
    watching, seen, memory = attached(policy, env), env.reset(), None

    def step() -> None:
        nonlocal seen, memory
        assert not isinstance(seen, tuple)
        actions, memory = watching.predict(seen, memory)
        seen = env.step(actions)[0]
        if film:
            env.get_images()

    return seconds(step) * make_spec(config.task).horizon


def _row(cells: Iterable[str]) -> str:
    return "  ".join(cell.rjust(width) for cell, width in zip(cells, COLUMNS.values(), strict=True))


def _duration(value: float) -> str:
    hours, rest = divmod(round(value), 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s"


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
