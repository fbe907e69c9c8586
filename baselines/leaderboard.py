"""``torchmpm leaderboard``: policies under one fixed protocol, and their ranking.

The protocol never changes; another way to evaluate gets another name. It is the same for all policies, whatever they
were trained in, but for the orientation of the action array.
"""

from __future__ import annotations

import hashlib
import json
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import torchmpm
from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare.evaluation import play_episodes
from baselines.compare.plan import read_record
from baselines.compare.report import SEES
from baselines.registry import configure, load, sees
from cfp.config import EnvironmentConfig, RunConfig
from cfp.errors import ConfigError
from cfp.evaluation.returns import t_interval
from cfp.experiment.cli import read_command, run_command
from cfp.experiment.folder import Folder
from cfp.files import read_json, write_json
from cfp.hub import is_address
from cfp.policy import Policy, check_names, check_trained_for, policy_file, shipped
from cfp.registry import algo_of
from cfp.tables import Table, columns
from dittogym import make_spec
from dittogym.action import trained_layout

#: Name of the protocol.
PROTOCOL = "v1"
#: Tasks, each with a ranking of its own; all of them define success.
TASKS = ("shapematch", "run", "grow", "kick", "dig", "obstacle", "catch", "slot")
#: Lite particles, because the paper's counts take a laptop about ten times as long. The rest is as in the registered
#: environments, written down because their defaults may change.
ENVIRONMENT = EnvironmentConfig(num_envs=1, particles="lite", substeps=100, dt=1e-4, dtype="float32")
#: Seeds of the layouts, with one episode each. A run with seed s, at most 2^31, trains, chooses and evaluates its
#: policy on seeds from s to s + 30,000.
SEEDS = range(3_000_000_000, 3_000_000_008)
#: The robot's particles on each layout in tasks that draw no positions at random, and so start alike with every seed.
COUNTS = range(2000, 1680, -40)
#: Largest difference of scores, which are rounded to three decimals, from those that the episodes give.
TOLERANCE = 0.0015
#: What a file of results states of the training, in numbers.
TRAINING = ("steps", "minutes")
#: A file of results: its entries and their types.
ENTRIES: dict[str, Any] = {
    "protocol": str,
    "task": str,
    "policy": str,  # the name that is shown
    "sha256": str | None,  # of the policy file; None for reference policies
    "sees": str,
    "training": dict,  # `TRAINING`, teachers included, as the submitter states them; None if not known
    "library": str,  # version that played the episodes
    "returns": list,  # undiscounted, one per layout
    "successes": list,  # as many
    "scores": dict,  # what follows from them
}
SHOWN = (
    *columns("d", rank="rank"),
    *columns(policy="policy", sees="observes"),
    *columns(",.1f", mean="return", interval="± 95 %"),
    *columns(".0%", success="success"),
    *columns(",d", steps="steps"),
    *columns(",.0f", minutes="minutes"),
    *columns(library="version"),
)
EXAMPLES = ("docs/leaderboard/*.json runs/mine --out runs/mine", "zero random --tasks run kick --out runs/rest")


@dataclass(frozen=True)
class Command:
    """Evaluate policies under the protocol v1 of the leaderboard, and rank them by their mean return.

    Writes a file of results for each policy that is not given as such a file, and prints a table of each task, ranked
    among the policies that observe the same. Reference policies are listed below them, without a rank.
    """

    policies: tyro.conf.Positional[tuple[str, ...]]
    """Run folders, policy files, pretrained policies, hf://OWNER/NAME, zero, random, scripted, or results (.json)."""
    tasks: tuple[str, ...] = TASKS
    """Where the reference policies act."""
    out: Folder = Path("runs/leaderboard")
    """Folder for the files of results."""


def episodes(task: str, policy: Policy) -> tuple[list[float], list[bool]]:
    """Returns and successes of a policy under the protocol."""
    environment = vars(ENVIRONMENT) | {"action_layout": trained_layout(policy) or "image"}
    config: RunConfig = replace(configure({"task": task}), device="cpu", **environment)
    if not make_spec(task).starts_alike:
        played = play_episodes(config, policy, SEEDS, deterministic=True)
    else:
        played = ()
        for seed, count in zip(SEEDS, COUNTS, strict=True):
            there = replace(config, particles=count)
            played += play_episodes(there, policy, [seed], deterministic=True)
    return [round(episode.total, 3) for episode in played], [bool(episode.success) for episode in played]


def scores(returns: Sequence[float], successes: Sequence[bool]) -> dict[str, float]:
    """What follows from the episodes."""
    mean, interval = float(np.mean(returns)), t_interval(returns)
    assert interval is not None
    return {"mean": round(mean, 3), "interval": round(interval, 3), "success": sum(successes) / len(successes)}


def candidates(name: str, tasks: Sequence[str]) -> list[tuple[dict[str, Any], Policy]]:
    """A policy, or a reference policy for each of the tasks, with its results except for the episodes."""
    about: dict[str, Any]
    if name in REFERENCE_POLICIES:
        about = {"policy": name, "sha256": None, "sees": "nothing", "training": {"steps": None, "minutes": None}}
        found = {task: REFERENCE_POLICIES[name](configure({"task": task})) for task in tasks}
    else:
        file = policy_file(name)
        policy = load(file)
        description = policy.description
        task = description["task"]
        found = {task: policy}
        check_trained_for(f"policies: {name}", description, task, ENVIRONMENT)
        about = {
            "policy": _shown_name(name, task),
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
            "sees": sees(algo_of(description)),
            "training": {"steps": description["steps"], "minutes": _minutes(file.parent)},
        }
    for task in found:
        if task not in TASKS:
            raise ConfigError(f"task must be one of {', '.join(TASKS)} on the leaderboard, got {task!r}")
    return [({"protocol": PROTOCOL, "task": task, **about}, policy) for task, policy in found.items()]


def _minutes(folder: Path) -> float | None:
    """Wall time of a training that a comparison has made; None if it is not known."""
    record = read_record(folder)
    return round(record["seconds"] / 60, 1) if "seconds" in record else None


def _shown_name(path: str, task: str) -> str:
    """The name of a policy: that of its run folder, its file or its repository."""
    if path == task and path in shipped() and not Path(path).exists():
        return "pretrained"
    place = Path(re.split("[@?]", path)[0] if is_address(path) else path).resolve()
    name = place.parent.name if place.stem == "policy" else place.name.removesuffix(".safetensors")
    return re.sub(r"[^\w.,+()-]", "-", name, flags=re.ASCII)[:60]


def read_results(path: Path) -> dict[str, Any]:
    """Read a file of results and check it; a `ConfigError` names what is wrong in it."""
    try:
        row = read_json(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as JSON ({error})") from error
    for name, kind in ENTRIES.items():
        if name not in row or not isinstance(row[name], kind):
            raise ConfigError(f"{path}: {name} must be of type {kind}, got {row.get(name)!r}")
    allowed = {"protocol": (PROTOCOL,), "task": TASKS, "sees": SEES}
    for name, values in allowed.items():
        if row[name] not in values:
            raise ConfigError(f"{path}: {name} must be one of {', '.join(values)}, got {row[name]!r}")
    for name, kinds in (("returns", int | float), ("successes", bool)):
        if len(row[name]) != len(SEEDS) or not all(isinstance(value, kinds) for value in row[name]):
            raise ConfigError(f"{path}: {name} must have {len(SEEDS)} values, one per layout, got {row[name]}")
    for name, value in scores(row["returns"], row["successes"]).items():
        given = row["scores"].get(name)
        if not (isinstance(given, int | float) and abs(given - value) <= TOLERANCE):  # NaN is wrong, too
            raise ConfigError(f"{path}: scores.{name} must be {value:.3f}, as the episodes give, got {given!r}")
    for name in TRAINING:
        if not isinstance(value := row["training"].get(name), int | float | None):
            raise ConfigError(f"{path}: training.{name} must be a number or null, got {value!r}")
    return row


def is_reference(row: dict[str, Any]) -> bool:
    """Whether results are those of a reference policy, which has no file."""
    return row["sha256"] is None


def rankings(results: Iterable[dict[str, Any]]) -> list[Table]:
    """A table for every task that has results, named by the task; reference policies come last and have no rank."""
    rows = [row | {name: row["training"].get(name) for name in TRAINING} | row["scores"] for row in results]
    rows.sort(key=lambda row: (is_reference(row), SEES.index(row["sees"]), -row["mean"]))
    for row in rows:
        rivals = [other for other in rows if (other["task"], other["sees"]) == (row["task"], row["sees"])]
        better = sum(other["mean"] > row["mean"] for other in rivals if not is_reference(other))
        row["rank"] = "reference" if is_reference(row) else 1 + better
    description = f"Mean return of {len(SEEDS)} episodes under protocol {PROTOCOL}."
    tables = (Table(task, description, SHOWN, [row for row in rows if row["task"] == task]) for task in TASKS)
    return [table for table in tables if table.rows]


def run(command: Command) -> None:
    """Evaluate and rank."""
    if not command.policies:
        raise ConfigError("policies must be one or more, got none")
    paths = [Path(name) for name in command.policies if name.endswith(".json")]
    results = {path.resolve(): read_results(path) for path in paths}  # a policy counts once
    names = [name for name in command.policies if not name.endswith(".json")]
    found = [candidate for name in names for candidate in candidates(name, command.tasks)]
    check_names((row["task"], row["policy"], row["sha256"]) for row, _ in found)
    for row, policy in found:
        command.out.mkdir(parents=True, exist_ok=True)
        returns, successes = episodes(row["task"], policy)
        row |= {"library": torchmpm.__version__, "returns": returns, "successes": successes}
        row |= {"scores": scores(returns, successes)}
        path = command.out / f"{row['task']}-{row['policy']}.json"
        write_json(path, row)
        print(f"{path}: {json.dumps(row['scores'])}", flush=True)
        results[path.resolve()] = row
    print("\n\n".join(table.to_markdown() for table in rankings(results.values())))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: run(read_command(Command, "baselines.leaderboard", EXAMPLES, arguments)))


if __name__ == "__main__":
    sys.exit(main())
