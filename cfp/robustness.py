"""``python -m cfp.robustness RUN_FOLDER``: what a policy still returns under disturbances and other constants."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from matplotlib.figure import Figure

from cfp.config import RunConfig
from cfp.envs.disturbances import FRICTION, Case, changes_something, disturbed_env, make_cases
from cfp.errors import ConfigError, check_at_least
from cfp.evaluate import Selection
from cfp.evaluation.page import write_figure
from cfp.evaluation.returns import Result, evaluate, evaluation_seed, make_trial, numbers
from cfp.experiment.cli import read_command, run_command
from cfp.experiment.folder import Folder
from cfp.files import write_json, write_text
from cfp.policy import Policy
from cfp.tables import Column, Table
from dittogym.spec import TaskSpec

EXAMPLES = ("runs/run", "--policy run --cases noise gravity --out runs/noise")
COLUMNS = (
    Column("case", "case"),
    Column("episodes"),
    Column("mean", "return", ".1f"),
    Column("std"),
    Column("interval", "± 95 %", ".1f"),
    Column("ratio", "ratio", ".3f"),
    Column("success", "success", ".0%"),
)


@dataclass(frozen=True)
class Command(Selection):
    """Evaluate the policy of a run's last stage, or a single policy, under disturbances and changed constants.

    The episodes of every case start on the same layouts.

    Writes robustness.md, .csv, .json and .png.
    """

    episodes: int = 5
    """Episodes of each row."""
    out: Folder | None = None
    """Folder to write into; the run's own if not given."""
    dropout: float = 0.2
    """Share of action entries, and of observation entries, set to zero in every step."""
    action_noise: float = 0.2
    """Standard deviation of Gaussian noise on every action entry."""
    latency: int = 1
    """Control steps by which actions come late."""
    shift: float = 0.2
    """mu, yield stress and gravity are tried at 1 - shift and 1 + shift times their value."""
    friction: tuple[float, ...] = FRICTION
    """Coulomb coefficients of the floor; inf sticks. That of the task is left out."""
    cases: tuple[str, ...] = ()
    """Try only cases whose names hold one of these words, such as "dropout", beside the unperturbed one; all if not
    given."""

    def check(self) -> None:
        """Refuse values that are out of range."""
        check_at_least(1, episodes=self.episodes, latency=self.latency)
        if self.out is None and self.folder is None and self.policy is not None:
            raise ConfigError("out must be given with a single policy: the folder to write into")
        for name in ("dropout", "shift"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(f"{name} must be above 0 and below 1, got {getattr(self, name)}")
        if not 0 < self.action_noise < math.inf:
            raise ConfigError(f"action_noise must be positive and finite, got {self.action_noise}")
        if not all(value >= 0 for value in self.friction):
            raise ConfigError(f"friction must be at least 0 (inf sticks), got {self.friction}")


def choose(cases: Sequence[Case], words: Sequence[str], spec: TaskSpec, policy: Policy) -> list[Case]:
    """The first case, and those whose names hold one of the words, if any; each word must choose one with an effect."""
    names = [case.name for case in cases[1:] if changes_something(case, spec, policy.uses_image)]
    for word in words:
        if not any(word in name for name in names):
            raise ConfigError(f"cases must be words of {', '.join(names)}, got {word!r}")
    return [*cases[:1], *(case for case in cases[1:] if not words or any(word in case.name for word in words))]


def report(
    config: RunConfig,
    policy: Policy,
    cases: Sequence[Case],
    episodes: int,
    *,
    deterministic: bool | None = None,
    progress: bool = False,
) -> list[Result]:
    """Evaluate a policy in every case that changes something for it, on the same layouts with the same noise."""
    if deterministic is None:
        deterministic = policy.deterministic_by_default
    spec, seed = config.make_spec(), evaluation_seed(config)
    trial = make_trial(config, "", policy, episodes, deterministic=deterministic, seed=seed)
    trials = [
        replace(
            trial,
            name=case.name,
            make_env=partial(disturbed_env, config, policy.resolution, case, trial.resolution),
        )
        for case in cases
        if changes_something(case, spec, policy.uses_image)
    ]
    return evaluate(trials, spec.horizon if progress else None)


def to_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Results as JSON values, ``ratio`` to the first one's mean; None where that is not positive."""
    base = results[0].mean
    return [
        {"case": result.name, "ratio": round(result.mean / base, 4) if base > 0 else None, **numbers(result)}
        for result in results
    ]


def make_table(name: str, config: RunConfig, rows: Sequence[dict[str, Any]]) -> Table:
    """The table of the report about the policy ``name``."""
    description = (
        f"Mean return of {rows[0]['episodes']} episodes, particles {config.particles}, and ratio to the unperturbed."
    )
    if rows[0]["ratio"] is None:
        description += " The unperturbed return is not positive, so that there are no ratios to it."
    return Table("robustness", f"Robustness of {name}", description, COLUMNS, rows)


def draw(config: RunConfig, results: Sequence[Result]) -> Figure:
    """A bar for every case: its ratio to the unperturbed return, or its return where that is not positive."""
    base = results[0].mean
    unit = base if base > 0 else 1.0
    figure = Figure(figsize=(8, 0.8 + 0.3 * len(results)), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    names, values = [result.name for result in results], [result.mean / unit for result in results]
    errors = [(result.interval or 0.0) / unit for result in results]
    axes.barh(names, values, xerr=errors, color=["tab:gray"] + ["tab:blue"] * (len(results) - 1), ecolor="black")
    axes.axvline(base / unit, color="black", linewidth=1, linestyle="--")
    axes.invert_yaxis()
    axes.set_xlabel("ratio to the unperturbed return" if base > 0 else "return (unperturbed: not positive)")
    axes.set_title(f"{config.algo} on {config.task}, {len(results[0].returns)} episodes, 95 % intervals", fontsize=10)
    axes.grid(alpha=0.3, axis="x")
    return figure


def run(command: Command) -> str:
    """Evaluate all cases, write the files, and return the table."""
    command.check()
    cases = make_cases(command.dropout, command.action_noise, command.latency, command.shift, command.friction)
    config, policies = command.open()
    policy, folder = list(policies.values())[-1], command.out or command.folder
    assert folder is not None
    cases = choose(cases, command.cases, config.make_spec(), policy)
    folder.mkdir(parents=True, exist_ok=True)
    results = report(config, policy, cases, command.episodes, progress=True)
    rows, path = to_rows(results), folder / "robustness"
    table = make_table(command.policy or config.name, config, rows)
    write_json(path.with_suffix(".json"), rows)
    write_text(path.with_suffix(".csv"), table.to_csv())
    write_text(path.with_suffix(".md"), table.to_markdown() + "\n")
    write_figure(path.with_suffix(".png"), draw(config, results))
    return f"{table.to_markdown()}\n\nbar plot: {path.with_suffix('.png')}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: print(run(read_command(Command, "cfp.robustness", EXAMPLES, arguments))))


if __name__ == "__main__":
    sys.exit(main())
