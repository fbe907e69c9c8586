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
    """Numbers of the README's table by task: zero actions, ours, success (%), paper, minutes, steps here and there."""
    lines = re.findall(r"^\| ([A-Z ]+) \| (.*\d.*) \|$", (ROOT / "README.md").read_text(), re.MULTILINE)
    numbers = {name.lower().replace(" ", ""): re.findall(r"-?\d[\d,]*", cells) for name, cells in lines}
    return {task: [float(number.replace(",", "")) for number in found] for task, found in numbers.items()}


@pytest.mark.parametrize("row", rows("training.csv"), ids=lambda row: row["task"])
def test_readme_shows_the_committed_figures(row):
    task = row["task"]
    full = {
        policy["policy"]: policy
        for policy in sorted(rows("policies.csv"), key=lambda policy: int(policy["episodes"]))
        if policy["task"] == task and policy["particles"] == "full"
    }
    ours = (full["zero"]["mean"], full[task]["mean"], 100 * float(full[task]["success"]))
    expected = [*ours, paper.CURVES[task][0][0], row["minutes"], row["steps"], paper.STEPS[task]]
    assert table()[task] == [float(value) for value in expected]


def test_no_line_of_a_page_is_a_comment():
    """In MyST a line that begins with a percent sign is left out of the page."""
    for page in (*ROOT.glob("*.md"), *ROOT.glob("benchmarks/*.md"), *(ROOT / "docs").rglob("*.md")):
        if "_build" not in page.parts:
            lines = page.read_text().splitlines()
            assert not [line for line in lines if line.lstrip().startswith("%")], page
