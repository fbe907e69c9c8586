"""What the run folders of a comparison say, read for the report."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from baselines.compare.evaluations import Judged, Judging, read
from baselines.compare.plan import Job, read_sessions
from cfp.sections import Particles
from cfp.tables import read_table

Curve = tuple[np.ndarray, np.ndarray]
"""Steps (N,) and values (N,)."""


@dataclass(frozen=True)
class Cost:
    """What training took, of the sessions that ended in order.

    Attributes:
        reached: Environment steps of the run after the last of them.
        steps: Environment steps in these sessions.
        seconds: Wall time of them, without evaluations and without the training of a teacher.
        judging: Seconds of evaluations between them, the teacher's included.
        teaching: Seconds of the training of a teacher that came first, 0 for none.
        taught: Environment steps of that.
        memory: Most bytes that a process held, None if not measured.
        device: Where it ran.
    """

    reached: int
    steps: int
    seconds: float
    judging: float
    teaching: float
    taught: int
    memory: int | None
    device: str


@dataclass(frozen=True)
class Found:
    """A run of the comparison with all that is known of it.

    Attributes:
        job: The run.
        state: See `Job.state`; unjudged if it is finished but its final evaluation is not whole.
        error: Why it failed.
        curve: Evaluations while it trained.
        cost: None if no session has ended in order.
        judged: None if it has not been.
    """

    job: Job
    state: str
    error: str
    curve: Curve
    cost: Cost | None
    judged: Judged | None

    @property
    def score(self) -> float | None:
        """Mean return over the common layouts."""
        return None if self.judged is None else float(np.mean(self.judged.returns))


@dataclass(frozen=True)
class Group:
    """The runs of one algorithm on one task, one for each seed.

    Attributes:
        task: Name.
        sees: What its policies look at.
        label: Of the algorithm.
        runs: All of them, finished or not.
    """

    task: str
    sees: str
    label: str
    runs: tuple[Found, ...]

    @property
    def scores(self) -> list[float]:
        """Mean returns of the runs that were judged."""
        return [run.score for run in self.runs if run.score is not None]

    @property
    def algo(self) -> str:
        """Which algorithm the label stands for."""
        return self.runs[0].job.config.algo

    @property
    def untrained(self) -> bool:
        """Whether nothing is learned."""
        return self.runs[0].job.untrained

    @property
    def particles(self) -> Particles:
        """Of the evaluations while it trains."""
        return self.runs[0].job.config.environment.particles

    @property
    def costs(self) -> list[Cost]:
        """Of the runs of which a session has ended in order."""
        return [run.cost for run in self.runs if run.cost is not None]

    @property
    def speed(self) -> float | None:
        """Environment steps per second of all these sessions together, without evaluations; None without any."""
        costs = self.costs
        return sum(cost.steps for cost in costs) / sum(cost.seconds for cost in costs) if costs else None

    @property
    def teaching(self) -> float:
        """Mean seconds of the training of the runs' teachers."""
        return float(np.mean([cost.teaching for cost in self.costs])) if self.costs else 0.0

    @property
    def curves(self) -> list[Curve]:
        """Of the runs that have one."""
        return [run.curve for run in self.runs if len(run.curve[0])]


def find_runs(jobs: Iterable[Job], judging: Callable[[Job], Judging]) -> list[Found]:
    """Read all run folders.

    Args:
        jobs: The comparison.
        judging: How the policy of a run is judged.
    """
    return [_find(job, judging(job)) for job in jobs]


def _find(job: Job, judging: Judging) -> Found:
    error, judged, state = job.folder / "error.txt", read(job.folder, judging), job.state
    if state == "finished" and (judged is None or not judged.whole):
        state = "unjudged"
    return Found(
        job,
        state,
        error.read_text().strip() if error.exists() else "",
        _curve(job.folder),
        _cost(job.folder),
        judged,
    )


def _curve(folder: Path) -> Curve:
    """Of evaluations at the same step, at a handover, the last counts: what goes on from there."""
    rows = read_table(folder / "evaluations.csv", ("step", "mean"))
    values = {float(row["step"]): float(row["mean"]) for row in rows}
    steps = np.array(sorted(values))
    return steps, np.array([values[step] for step in steps])


def _cost(folder: Path) -> Cost | None:
    sessions: list[dict[str, Any]] = read_sessions(folder)["sessions"]
    steps = sum(session["to"] - session["from"] for session in sessions)
    if not steps:
        return None
    memories = [session["memory"] for session in sessions if session["memory"]]
    judging = sum(session["judging"] for session in sessions)
    teachers = [session["teacher"] for session in sessions if "teacher" in session]  # sessions from before have none
    teaching = sum(teacher["seconds"] for teacher in teachers)
    seconds = sum(session["seconds"] for session in sessions) - judging - teaching
    return Cost(
        sessions[-1]["to"],
        steps,
        max(seconds, 1e-9),
        judging,
        teaching,
        sum(teacher["steps"] for teacher in teachers),
        max(memories, default=None),
        "/".join(sorted({session["device"] for session in sessions})),
    )


SIGHTS = ("image", "state", "simulator", "nothing")
"""Order of groups in tables."""


def group(runs: Sequence[Found]) -> list[Group]:
    """Runs by task, what is seen, and algorithm; tasks and algorithms in the order of the comparison."""
    together: dict[tuple[str, str, str], list[Found]] = {}
    for run in runs:
        together.setdefault((run.job.config.task, run.job.sees, run.job.label), []).append(run)
    tasks = list(dict.fromkeys(task for task, _, _ in together))

    def order(key: tuple[str, str, str]) -> tuple[int, int]:
        return tasks.index(key[0]), SIGHTS.index(key[1]) if key[1] in SIGHTS else len(SIGHTS)

    return [Group(*key, tuple(together[key])) for key in sorted(together, key=order)]
