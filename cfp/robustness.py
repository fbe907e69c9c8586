"""``python -m cfp.robustness POLICY``: all that is said of a policy, by one protocol that all policies share."""

from __future__ import annotations

import csv
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import tyro

from cfp.config import RunConfig, check_task
from cfp.errors import ConfigError, check_at_least
from cfp.evaluate import open_policy
from cfp.evaluation.returns import Result, UntrainedPolicy, decision_grid, evaluate, make_trial, without_noise
from cfp.experiment.cli import read_command, run_command
from cfp.files import check_output, write_text
from cfp.hub import is_address
from cfp.policy import Policy, check_names, check_trained_for, policy_file
from cfp.tables import Table, columns, csv_text
from dittogym import Conditions
from dittogym.spec import DT, TaskSpec

EXAMPLES = ("run kick --rows evaluations.csv", "runs/run --episodes 5 --full 0 --disturbed 5 --cases latency noise")

#: Name of the protocol; v1 is that of the leaderboard.
PROTOCOL = "v2"
#: Seed of the first start. A run with seed s, at most 2^31, uses seeds from s to s + 30,000.
SEED = 4_000_000_000
#: How starts differ.
STARTS = Conditions(shift=0.01, turn=5.0, velocity=0.05)
UNDISTURBED, OWN_START = "undisturbed", "own start"
#: Constants of the matter that are changed by a fifth.
MATTER = ("mu", "yield_stress", "gravity")
#: Disturbances by the names of their cases, as options of `dittogym.Conditions`.
DISTURBANCES: dict[str, dict[str, Any]] = {
    "action dropout": {"action_dropout": 0.2},
    "observation dropout": {"observation_dropout": 0.2},
    "latency": {"latency": 1},
    "action noise": {"action_noise": 0.2},
    **{f"{name.replace('_', ' ')} x {factor}": {name: factor} for name in MATTER for factor in (0.8, 1.2)},
}
#: Columns of a table of evaluations: those that tell rows apart, others that must be the same for a row to be kept, and
#: what was measured.
KEY = ("protocol", "task", "policy", "case", "particles", "noise")
SAME = (*KEY, "sha256", "episodes")
RETURNS = ("mean", "interval", "std", "lowest", "highest")
SHARES = ("success", "success_whole", "torn", "piece", "mean_piece")  # see `cfp.evaluation.returns.Result`
COLUMNS = (*SAME, *RETURNS, *SHARES)
SHOWN = (
    *columns(case="case", particles="particles"),
    *columns("g", episodes="episodes"),
    *columns(",.1f", mean="return", interval="± 95 %"),
    *columns(".2f", ratio="ratio", quotient="quotient"),
    *columns(".0%", success="success", success_whole="and not torn", piece="one piece", mean_piece="over the episode"),
)
Row: TypeAlias = dict[str, str]
Key: TypeAlias = tuple[str, ...]
Tier: TypeAlias = Literal["full", "lite"]


@dataclass(frozen=True)
class Command:
    """Evaluate policies: return, success and mass in one piece, undisturbed, with full particles, and disturbed.

    All policies of a task play the same episodes, beside zero and random actions: the starts are ones that nothing was
    trained or chosen on, and vary by 0.01 m, 5 degrees and 0.05 m/s, but for those of the case "own start". A ratio is
    (R - Z) / (R0 - Z0): R0 and Z0 are the undisturbed returns of the policy and of zero actions with lite particles, Z
    that of zero actions with as many particles as R; the quotient is R / R0.
    """

    policies: tyro.conf.Positional[tuple[str, ...]]
    """Run folders, policy files, pretrained policies, or hf://OWNER/NAME; rows are named by the folder or file."""
    rows: Path | None = None
    """Table (.csv) for the results; rows of the same policy file and number of episodes are kept, not played again."""
    episodes: int = 100
    """Undisturbed episodes with lite particles."""
    full: int = 20
    """Episodes with full particles, as many from varied starts as from the task's own."""
    disturbed: int = 20
    """Episodes of each disturbance, and of zero and random actions, with lite particles."""
    cases: tuple[str, ...] = ()
    """Only disturbances whose names hold one of these words, such as dropout; all if not given."""
    noise: Literal["default", "with", "without"] = "default"
    """Action noise of the policies: with, without, or default, as trained."""
    device: str = "auto"
    """cpu, cuda, or auto."""

    def check(self) -> None:
        """Refuse values that are out of range."""
        if not self.policies:
            raise ConfigError("policies must be one or more, got none")
        check_at_least(1, episodes=self.episodes)
        check_at_least(0, full=self.full, disturbed=self.disturbed)
        if self.rows is not None:
            check_output("rows", self.rows)


# What is played.


def effective(spec: TaskSpec, uses_image: bool) -> list[str]:
    """The disturbances that have an effect on a policy in a task."""
    every = {name: Conditions(**options) for name, options in DISTURBANCES.items()}
    nothing = [name for name in every if DISTURBANCES[name].keys() & {*MATTER} and not every[name].changes(spec)]
    return [name for name in every if name not in nothing and (uses_image or not every[name].hides_pixels)]


def choose(names: Sequence[str], words: Sequence[str]) -> list[str]:
    """The names that hold one of the words, all without words; each word must choose one."""
    for word in words:
        if not any(word in name for name in names):
            raise ConfigError(f"cases must be words of {', '.join(names)}, got {word!r}")
    return [name for name in names if not words or any(word in name for word in words)]


@dataclass(frozen=True)
class Evaluation:
    """What a row is to say: some episodes of a policy in one case."""

    config: RunConfig  # the environment, but for its particles
    policy: Policy
    name: str
    sha256: str  # the beginning of that of its file; empty without one
    deterministic: bool
    case: str
    particles: Tier
    episodes: int

    @property
    def head(self) -> Row:
        """The columns `SAME` of its row."""
        options = [f"{name}={value}" for name, value in self.config.task_options().items()]
        values = PROTOCOL, " ".join((self.config.task, *options)), self.name, self.case, self.particles
        noise = "without" if self.deterministic else "with"
        return dict(zip(SAME, (*values, noise, self.sha256, str(self.episodes)), strict=True))

    def play(self) -> Row:
        """Play the episodes; returns the row."""
        conditions = None
        if self.case != OWN_START:
            disturbance = DISTURBANCES.get(self.case, {})
            conditions = replace(STARTS, **disturbance, grid=decision_grid(self.policy))
        trial = make_trial(
            replace(self.config, particles=self.particles),
            self.name,
            self.policy,
            self.episodes,
            deterministic=self.deterministic,
            seed=SEED,
            conditions=conditions,
        )
        name = f"{self.name}, {self.case}, {self.particles}"
        result = evaluate([trial], self.config.make_spec().horizon, name=name)[0]
        return self.head | _numbers(result)


def _numbers(result: Result) -> Row:
    """The other columns."""
    returns = (result.mean, result.interval, result.std, min(result.returns), max(result.returns))
    shares = (result.success, result.success_whole, result.torn, result.piece, result.mean_piece)
    texts = ["" if value is None else f"{value:.3f}" for value in (*returns, *shares)]
    return dict(zip(RETURNS + SHARES, texts, strict=True))


def plan(command: Command, given: str) -> list[Evaluation]:
    """All that a command evaluates for one policy, what is quick first."""
    file = policy_file(given)
    config, policies = open_policy(given, command.device, None)
    config, policy = replace(config, dt=DT, substeps=None, dtype="float32"), policies[file.stem]
    # The task is the policy's own, but its control step may be another.
    check_trained_for(f"policies: {given}", policy.description, config.task, config.environment)
    spec = config.make_spec()
    name = given if is_address(given) else file.resolve().parent.name if file.stem == "policy" else file.stem
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()[:12]
    lite: tuple[str, Tier, int] = (UNDISTURBED, "lite", command.disturbed)
    every: list[tuple[str, Tier, int]] = [
        (UNDISTURBED, "lite", command.episodes),
        *((case, "lite", command.disturbed) for case in choose(effective(spec, policy.uses_image), command.cases)),
        (UNDISTURBED, "full", command.full),
        (OWN_START, "full", command.full),
    ]
    zero = partial(Evaluation, config, UntrainedPolicy("zero", spec.coarse), "zero", "", True)
    random = partial(Evaluation, config, UntrainedPolicy("random", spec.coarse), "random", "", False)
    own = partial(Evaluation, config, policy, name, sha256, without_noise(policy, command.noise))
    others = [zero(*lite), random(*lite), zero(UNDISTURBED, "full", command.full)]
    found = [*others, *(own(*case) for case in every)]
    return sorted((each for each in found if each.episodes), key=lambda each: each.particles == "full")


# Rows.


def read_rows(path: Path | None) -> dict[Key, Row]:
    """The rows of a table of evaluations by what tells them apart; none if there is no such file."""
    if path is None or not path.exists():
        return {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"rows: {path} cannot be read ({error})") from error
    if tuple(reader.fieldnames or ()) != COLUMNS:
        raise ConfigError(f"rows: {path} must be a table with the columns {', '.join(COLUMNS)}")
    return {tuple(row[name] for name in KEY): row for row in rows}


def ratios(row: Row, rows: Sequence[Row]) -> tuple[float | None, float | None]:
    """Ratio and quotient of a policy's row, see `Command`; None where rows for them are missing or not positive."""

    def undisturbed(policy: str, particles: str) -> float | None:
        wanted = {"protocol": PROTOCOL, "task": row["task"], "case": UNDISTURBED}
        wanted |= {"policy": policy, "particles": particles}
        wanted |= {} if policy == "zero" else {"noise": row["noise"]}
        return next((float(each["mean"]) for each in rows if wanted.items() <= each.items()), None)

    base, value = undisturbed(row["policy"], "lite"), float(row["mean"])
    zero, zero_there = undisturbed("zero", "lite"), undisturbed("zero", row["particles"])
    if base is None or not row["sha256"] or row["case"] == OWN_START:
        return None, None
    ratio = None
    if zero is not None and zero_there is not None and base > zero:
        ratio = (value - zero_there) / (base - zero)
    return ratio, value / base if base > 0 else None


def make_table(rows: Sequence[Row], every: Sequence[Row]) -> Table:
    """The table about one policy, whose rows are among ``every``."""
    shown: list[dict[str, Any]] = []
    for row in rows:
        case = row["case"] if row["sha256"] else f"{row['policy']} actions"
        numbers = {name: float(row[name]) if row[name] else None for name in ("episodes", *RETURNS, *SHARES)}
        shown.append(row | numbers | {"case": case} | dict(zip(("ratio", "quotient"), ratios(row, every), strict=True)))
    own = rows[-1]
    title = f"{own['policy']} on {own['task']}"
    return Table(title, f"Protocol {PROTOCOL}, {own['noise']} action noise.", SHOWN, shown)


def run(command: Command) -> None:
    """Evaluate, put the rows into their table, and print what they say of each policy."""
    command.check()
    plans = [plan(command, given) for given in command.policies]
    for evaluations in plans:
        check_task(evaluations[0].config.task)  # the module of a later policy may have replaced it
    check_names((each.head["task"], each.name, each.sha256) for evaluations in plans for each in evaluations)
    rows = read_rows(command.rows)
    for evaluations in plans:
        heads = [each.head for each in evaluations]
        keys = [tuple(head[name] for name in KEY) for head in heads]
        for each, head, key in zip(evaluations, heads, keys, strict=True):
            if head.items() <= rows.get(key, {}).items():
                continue
            row = each.play()
            rows |= read_rows(command.rows)  # to which another program may have added some
            rows = {other: found for other, found in rows.items() if not _is_of_another_file(found, row)} | {key: row}
            if command.rows is not None:
                write_text(command.rows, csv_text(rows.values(), COLUMNS), shared=True)
        print(make_table([rows[key] for key in keys], list(rows.values())).to_markdown(), flush=True)


def _is_of_another_file(row: Row, new: Row) -> bool:
    """Whether a row is about an earlier policy of the same name."""
    return all(row[name] == new[name] for name in ("task", "policy")) and row["sha256"] != new["sha256"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: run(read_command(Command, "cfp.robustness", EXAMPLES, arguments)))


if __name__ == "__main__":
    sys.exit(main())
