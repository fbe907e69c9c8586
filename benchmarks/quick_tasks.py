"""Training speed and memory of every task: ``python benchmarks/quick_tasks.py --out FOLDER --table TABLE.csv``.

Trains each task with the quick preset through both stages, in a process of its own, and adds a row to the table:
training steps per second of each stage (median of the values in TensorBoard), peak memory of the process, and the mean
returns of the final evaluation. Tasks that the table already holds are skipped. Further options go to the training.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cfp.tables import CSVTable, read_table
from dittogym import TASKS


def train(task: str, folder: Path, steps: int, options: list[str]) -> int:
    """Train in a process of its own; returns its peak memory in bytes."""
    command = [sys.executable, "-m", "cfp.train", "--task", task, "--steps", str(steps), "--out", str(folder)]
    process = subprocess.Popen([*command, "--no-video", *options])
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{task}: training ended with exit code {os.waitstatus_to_exitcode(status)}")
    return usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def speeds(folder: Path) -> list[float]:
    """Median training steps per second of each stage."""
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    stages = {event.step: int(event.value) for event in events.Scalars("stage")}
    points: dict[int, list[float]] = {}
    for event in events.Scalars("time/steps_per_second"):
        points.setdefault(stages[event.step], []).append(event.value)
    return [statistics.median(points[stage]) for stage in sorted(points)]


def row(task: str, folder: Path, memory: int) -> dict[str, object]:
    """A row of the table."""
    first, second = speeds(folder)
    cells: dict[str, object] = {"task": task, "step": int(read_table(folder / "progress.csv")[-1]["step"])}
    cells |= {"steps/s, stage 1": f"{first:.1f}", "steps/s, stage 2": f"{second:.1f}"}
    cells["memory (MiB)"] = round(memory / 2**20)
    for result in json.loads((folder / "results.json").read_text()):
        cells[result["policy"]] = f"{result['mean']:.0f} ± {result['std']:.0f}"
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--table", type=Path, required=True, help="CSV file; rows are added")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--steps", type=int, default=2000)
    arguments, options = parser.parse_known_args()
    for task in arguments.tasks:
        table = CSVTable(arguments.table)
        if task in (line["task"] for line in table.rows):
            continue
        memory = train(task, arguments.out / task, arguments.steps, options)
        table.add(row(task, arguments.out / task, memory))


if __name__ == "__main__":
    main()
