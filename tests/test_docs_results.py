"""The table of the README shows the figures of the committed results."""

import csv
import re
from pathlib import Path

import pytest

from baselines.compare import paper

ROOT = Path(__file__).resolve().parents[1]


def rows(name: str) -> list[dict[str, str]]:
    with (ROOT / "docs" / name).open(newline="") as file:
        return list(csv.DictReader(file))


def table() -> dict[str, list[float]]:
    """Numbers of the README's table by task: zero actions, ours, paper, minutes, steps here and there."""
    lines = re.findall(r"^\| ([A-Z ]+) \| (.*\d.*) \|$", (ROOT / "README.md").read_text(), re.MULTILINE)
    numbers = {name.lower().replace(" ", ""): re.findall(r"-?\d[\d,]*", cells) for name, cells in lines}
    return {task: [float(number.replace(",", "")) for number in found] for task, found in numbers.items()}


@pytest.mark.parametrize("row", rows("training.csv"), ids=lambda row: row["task"])
def test_readme_shows_the_committed_figures(row):
    task = row["task"]
    full = {
        policy["policy"]: float(policy["mean"])
        for policy in sorted(rows("policies.csv"), key=lambda policy: int(policy["episodes"]))
        if policy["task"] == task and policy["particles"] == "full"
    }
    expected = [full["zero"], full[task], paper.CURVES[task][0][0], row["minutes"], row["steps"], paper.STEPS[task]]
    assert table()[task] == [float(value) for value in expected]
