"""The contents of the run folders of a comparison, read for the report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from baselines.compare.final_evaluation import FinalEvaluation, read_evaluation, read_record
from baselines.compare.jobs import Job, read_sessions
from baselines.compare.stats import Curve, interquartile_mean, score_interval
from cfp.experiment.algorithm import Sees
from cfp.sections import Particles
from cfp.tables import read_table

#: What policies observe, in the order of tables.
SEES = get_args(Sees)


@dataclass(frozen=True)
class Cost:
    """What training took, over the sessions that ended in order."""

    last_step: int  # environment steps of the run at the end of the last session
    steps: int  # environment steps in these sessions
    seconds: float  # without evaluations and without the training of a teacher
    evaluation_seconds: float  # those of a teacher included
    teacher_seconds: float  # training of a teacher that came first
    teacher_steps: int
    memory: int | None  # peak memory of a process in bytes, if measured
    device: str


@dataclass(frozen=True)
class RunResult:
    """A run of the comparison with all that is known of it."""

    job: Job
    state: str  # that of the job, or "unevaluated" if the final evaluation of a trained policy is not complete
    error: str  # why it failed
    curve: Curve  # mean returns of the evaluations during training
    cost: Cost | None
    evaluation: FinalEvaluation | None


@dataclass(frozen=True)
class Group:
    """The runs of one algorithm on one task, one per seed, finished or not."""

    task: str
    sees: str
    label: str
    job: Job  # the first run, for what all of them have in common
    evaluations: list[FinalEvaluation]  # of the runs that have one
    curves: list[Curve]  # of the runs that have one
    costs: list[Cost]  # of the runs of which a session has ended in order

    @property
    def scores(self) -> list[float]:
        """Mean returns of the runs that have been evaluated."""
        return [each.mean for each in self.evaluations]

    @property
    def iqm(self) -> float | None:
        """Interquartile mean of the scores."""
        return float(interquartile_mean(self.scores)) if self.scores else None

    @property
    def interval(self) -> tuple[float, float] | tuple[None, None]:
        """95 % interval of the interquartile mean; None twice for fewer than two runs."""
        return score_interval([self.scores])

    @property
    def particles(self) -> Particles:
        """Particles of the evaluations during training."""
        return self.job.config.environment.particles

    @property
    def speed(self) -> float | None:
        """Environment steps per second of training, over all sessions; None without any."""
        costs = self.costs
        return sum(cost.steps for cost in costs) / sum(cost.seconds for cost in costs) if costs else None

    def mean_cost(self, name: str) -> float:
        """Mean of a field of the costs, of which there must be some."""
        return float(np.mean([getattr(cost, name) for cost in self.costs]))


def read_result(job: Job) -> RunResult:
    """Read the folder of a run."""
    evaluation, state = read_evaluation(job.config, job.folder, job.protocol), job.state
    if state == "finished" and (evaluation is None or not evaluation.complete):
        state = "unevaluated"
    return RunResult(job, state, job.error, _read_curve(job.folder), read_cost(job.folder), evaluation)


def group_results(runs: Sequence[RunResult]) -> list[Group]:
    """Group runs by task, observation and algorithm; tasks and algorithms keep their order."""
    members: dict[tuple[str, str, str], list[RunResult]] = {}
    for run in runs:
        members.setdefault((run.job.config.task, run.job.sees, run.job.label), []).append(run)
    tasks, groups = list(dict.fromkeys(task for task, _, _ in members)), []
    for key in sorted(members, key=lambda key: (tasks.index(key[0]), SEES.index(key[1]))):
        evaluations = [run.evaluation for run in members[key] if run.evaluation is not None]
        curves = [run.curve for run in members[key] if len(run.curve[0])]
        costs = [run.cost for run in members[key] if run.cost is not None]
        groups.append(Group(*key, members[key][0].job, evaluations, curves, costs))
    return groups


def _read_curve(folder: Path) -> Curve:
    """At a handover there are two evaluations at the same step; the later one counts, from which training continues."""
    rows = read_table(folder / "evaluations.csv", ("step", "mean"))
    values = sorted({float(row["step"]): float(row["mean"]) for row in rows}.items())
    steps, means = np.array(values).reshape(-1, 2).T
    return steps, means


def read_cost(folder: Path) -> Cost | None:
    """What the training in a run folder took; None if it has no record of it."""
    sessions = read_sessions(folder)["sessions"]

    def total(name: str) -> float:
        return sum(session[name] for session in sessions)

    if not sessions or total("to") == total("from"):
        return None
    teacher: dict[str, Any] = {"steps": 0, "seconds": 0.0, "evaluation_seconds": 0.0}
    if (folder / "teacher" / "cost.json").exists():
        teacher = read_record(folder / "teacher" / "cost.json")
    return Cost(
        last_step=sessions[-1]["to"],
        steps=int(total("to") - total("from")),
        seconds=total("seconds") - total("evaluation_seconds"),
        evaluation_seconds=total("evaluation_seconds") + teacher["evaluation_seconds"],
        teacher_seconds=teacher["seconds"] - teacher["evaluation_seconds"],
        teacher_steps=teacher["steps"],
        memory=max((session["memory"] for session in sessions if session["memory"]), default=None),
        device="/".join(sorted({session["device"] for session in sessions})),
    )
