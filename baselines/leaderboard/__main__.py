"""``python -m baselines.leaderboard FILES``: checks submissions and ranks them."""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from baselines.compare.results import SEES
from baselines.compare.tables import rank
from baselines.leaderboard.protocol import PROTOCOLS
from baselines.leaderboard.submission import Submission, read_submissions
from cfp.experiment.cli import read_command, run_command
from cfp.tables import Table, columns

COLUMNS = (
    *columns("d", rank="rank"),
    *columns(policy="policy", sees="observes"),
    *columns(",.1f", mean="return", interval="± 95 %"),
    *columns(".0%", success="success"),
    *columns(",d", steps="steps"),
    *columns(",.0f", minutes="minutes"),
    *columns(library="version"),
)
EXAMPLES = ("docs/leaderboard/*.json runs/compare/submissions/*.json",)


@dataclass(frozen=True)
class Command:
    """Check submissions, which ``baselines.compare --protocol`` writes, and print a ranking of each task as Markdown.

    Policies are ranked by their mean return, among those that observe the same. If a file is not a valid submission,
    the command prints a line for each defect, ranks nothing and exits with code 2.
    """

    files: tyro.conf.Positional[tuple[Path, ...]]
    """Submissions (.json)."""


def rankings(submissions: Sequence[Submission]) -> list[Table]:
    """A table for every protocol and task that has submissions, named by the task."""
    tables = []
    for version, protocol in PROTOCOLS.items():
        for task in protocol.tasks:
            chosen = [each for each in submissions if (each.protocol, each.task) == (version, task)]
            rows = [asdict(each) | asdict(each.training) | asdict(each.scores) for each in chosen]
            rows.sort(key=lambda row: (SEES.index(row["sees"]), -row["mean"]))
            rank(rows, ("sees",), "mean")
            if rows:
                description = f"Mean return of {len(protocol.seeds)} episodes under protocol {version}."
                tables.append(Table(task, task, description, COLUMNS, rows))
    return tables


def run(command: Command) -> None:
    """Check and rank."""
    print("\n\n".join(table.to_markdown() for table in rankings(read_submissions(command.files))))


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: run(read_command(Command, "baselines.leaderboard", EXAMPLES, arguments)))


if __name__ == "__main__":
    sys.exit(main())
