"""What a run will cost, by a few timed steps and updates of each stage in a temporary folder."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from stable_baselines3.common.type_aliases import PolicyPredictor

from cfp.config import RunConfig
from cfp.envs.make import choose_device, make_env
from cfp.evaluation.evaluate import ZeroPolicy, attached
from cfp.evaluation.video import available
from cfp.experiment.algorithm import Algorithm, Cost, Position, mean_seconds
from cfp.experiment.callbacks import Stage
from cfp.experiment.checkpoint import Checkpoint
from cfp.experiment.folder import copy_policy, policy_path
from cfp.experiment.process import StopSignals, peak_memory
from cfp.experiment.run import Run
from cfp.policy import Policy
from dittogym import make_spec

COLUMNS = {"stage": 5, "action": 7, "steps": 11, "steps/s": 8, "training": 11, "evaluations": 11, "replay": 8}
"""Of the table, and their widths."""


def estimate(algorithm: type[Algorithm], config: RunConfig, resumed: Path | None = None) -> str:
    """Time and memory of a run as a table; no folder of the user's is touched.

    Args:
        algorithm: Its class.
        config: Its options.
        resumed: Folder of the run if it is going to be resumed: then only what its checkpoint leaves is counted.

    Raises:
        ConfigError: An option is wrong.
        CheckpointError: The checkpoint is damaged.
    """
    quiet = replace(config, report=replace(config.report, video=False, video_every=0, wandb="off"))
    ends, rows, total = config.ends(), [_row(COLUMNS)], 0.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        run = Run(algorithm, quiet, folder, False, StopSignals())
        first, costs = run.position.stage, _measure(run)
        lines = [f"not counted: {other}" for other in algorithm.not_estimated(config)]
        done, present = (0, *ends)[first - 1], first
        if resumed is not None and (checkpoint := Checkpoint(resumed / "checkpoint")).exists():
            state, lines = checkpoint.read(), []
            done, present = state["offset"] + state["num_timesteps"], state["stage"]
            rows.insert(0, f"{resumed} is at step {done:,} of {ends[-1]:,}; what is left of it:")
        for stage, (cost, starts_trained) in enumerate(costs, first):
            if stage < present:
                continue
            begin, end = ((0, *ends)[stage - 1 + later] for later in (0, 1))
            start, end = max(begin, done), max(end, done)
            training = (end - start) * cost.seconds_per_step
            policy = algorithm.load(policy_path(folder, stage), choose_device(config.device))
            reporting = _reporting(config, policy, stage, (start, end), starts_trained and start == begin)
            total += training + reporting
            grid = config.resolution(stage - 1)
            speed, times = f"{1 / cost.seconds_per_step:.1f}", (_duration(training), _duration(reporting))
            rows.append(_row((f"{stage}", f"{grid}x{grid}", f"{end - start:,}", speed, *times, _size(cost.memory))))
        ending = _ending(run, config)
        lines += algorithm.warnings(config, folder, present)
    memory, held = peak_memory(), max(cost.memory for cost, _ in costs)
    rows.append(
        f"time: about {_duration(total + ending)}, {_duration(ending)} of it for what follows the training; "
        f"of {config.report.eval_episodes} episodes to an evaluation that none ends early"
    )
    rows.append("memory: " + (f"about {_size(memory + held)}" if memory else f"{_size(held)} and the program itself"))
    return "\n".join([*rows, *lines])


def _measure(run: Run) -> list[tuple[Cost, bool]]:
    """Cost of each stage, over the untrained policy of the one before, and whether it starts with a trained policy."""
    costs = []
    run.algorithm.prepare(run.config, run.folder, None)
    for stage in range(run.position.stage, run.stages + 1):
        algorithm = run.algorithm.create(run.config, stage, run.folder)
        present = Stage(run.config, run.folder, Position(stage), algorithm)
        present.save_policy()
        copy_policy(policy_path(run.folder), policy_path(run.folder, stage))
        costs.append((algorithm.measure(), algorithm.starts_trained))
    run.logger.close()
    return costs


def _reporting(config: RunConfig, policy: Policy, stage: int, steps: tuple[int, int], evaluated_first: bool) -> float:
    """Seconds of the evaluations and films of a stage between two steps."""
    report, size, (start, end) = config.report, config.action_size(stage - 1), steps
    count = -(-end // report.eval_every) - start // report.eval_every if report.eval_every and end > start else 0
    count += bool(count and evaluated_first)
    films = end // report.video_every - start // report.video_every if report.video_every and available() else 0
    evaluating = count * _episodes(config, policy, size, config.evaluation(stage - 1)[1]) if count else 0.0
    return evaluating + (films * _episodes(config, policy, size, 1, film=True) if films else 0.0)


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

    return mean_seconds(step) * make_spec(config.task).horizon


def _row(cells: Iterable[str]) -> str:
    return "  ".join(cell.rjust(width) for cell, width in zip(cells, COLUMNS.values(), strict=True))


def _duration(value: float) -> str:
    hours, rest = divmod(round(value), 3600)
    return f"{hours} h {rest // 60} min" if hours else f"{rest // 60} min {rest % 60} s"


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
