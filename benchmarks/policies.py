"""Evaluate policies of single tasks for the table of docs/policies.md.

Run ``python benchmarks/policies.py --out docs/policies.csv POLICY...``; a policy is a name that comes with the package,
a policy file, or a run folder, all of whose stages are evaluated. Each one plays ``--episodes`` episodes with ``full``
and with ``lite`` particles, on layouts that nothing was trained or chosen on, beside zero and random action on fewer
layouts; then ``--success`` episodes with ``lite`` particles, for a narrower interval of the share of successes. Rows
with the same task, particles, policy and number of episodes are replaced in the table; everything else in it stays.
"""

import argparse
import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from cfp.config import RunConfig
from cfp.evaluate import open_policy, open_run
from cfp.evaluation.returns import Result, UntrainedPolicy, evaluate, evaluation_seed, make_trial
from cfp.files import write_text
from cfp.policy import Policy
from cfp.tables import csv_text

COLUMNS = ("task", "particles", "policy", "action", "episodes", "mean", "lowest", "highest", "std", "success")
KEY = ("task", "particles", "policy", "episodes")


def results(
    config: RunConfig, policies: dict[str, Policy], episodes: int, untrained: int, success: int
) -> Iterator[tuple[str, Result]]:
    """Results and the particle counts for which they hold."""
    seed, size = evaluation_seed(config), config.resolution(1)
    for particles in ("full", "lite"):
        there = replace(config, particles=particles)
        trials = [
            make_trial(there, kind, UntrainedPolicy(kind, size), untrained, deterministic=True, seed=seed)
            for kind in ("zero", "random")
            if untrained
        ]
        counts = (episodes, success) if particles == "lite" else (episodes,)
        for name, policy in policies.items():
            for count in counts:
                if count:
                    quiet = policy.deterministic_by_default
                    trials.append(make_trial(there, name, policy, count, deterministic=quiet, seed=seed))
        for result in evaluate(trials, there.make_spec().horizon):
            yield particles, result


def to_row(task: str, particles: str, result: Result) -> dict[str, Any]:
    """A row of the table."""
    return {
        "task": task,
        "particles": particles,
        "policy": result.name,
        "action": f"{result.resolution}x{result.resolution}",
        "episodes": len(result.returns),
        "mean": f"{result.mean:.0f}",
        "lowest": f"{min(result.returns):.0f}",
        "highest": f"{max(result.returns):.0f}",
        "std": f"{result.std:.0f}",
        "success": "" if result.success is None else f"{result.success:.2f}",
    }


def merge(path: Path, rows: list[dict[str, Any]]) -> None:
    """Put rows into the table."""
    table: dict[tuple[str, ...], dict[str, Any]] = {}
    if path.exists():
        with path.open(newline="") as file:
            table = {tuple(row[name] for name in KEY): row for row in csv.DictReader(file)}
    table |= {tuple(str(row[name]) for name in KEY): row for row in rows}
    write_text(path, csv_text(table.values(), COLUMNS))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="+", help="names, policy files or run folders")
    parser.add_argument("--out", type=Path, required=True, help="the table")
    parser.add_argument("--episodes", type=int, default=10, help="episodes of each policy and number of particles")
    parser.add_argument("--untrained", type=int, default=3, help="episodes of zero and random action")
    parser.add_argument("--success", type=int, default=100, help="lite episodes for the share of successes; 0: none")
    arguments = parser.parse_args()
    for given in arguments.policies:
        if (Path(given) / "config.json").exists():
            config, policies = open_run(Path(given), "cpu")
        else:
            config, policies = open_policy(given, "cpu", None)
        rows = []
        for particles, result in results(config, policies, arguments.episodes, arguments.untrained, arguments.success):
            rows.append(to_row(config.task, particles, result))
            print(*rows[-1].values(), flush=True)
        merge(arguments.out, rows)


if __name__ == "__main__":
    main()
