"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from baselines.compare import paper
from baselines.compare.results import Found, Group
from baselines.compare.stats import common_curve, first_reach, interquartile_mean, interval, wilson
from baselines.compare.table import Column, Table
from cfp.sections import Particles
from dittogym import make_spec

SHARES = (0.5, 0.75, 0.9)
"""Of the way from a resting robot to the best curve, for sample efficiency."""
WHO = (Column("task", "task"), Column("sees", "sees"), Column("algo", "algorithm"))
SEPARATE = (
    "Ranks are within a task and within what policies see: image, state, simulator and nothing are never ranked "
    "together."
)

Row = dict[str, Any]


def _who(group: Group) -> Row:
    return {"task": group.task, "sees": group.sees, "algo": group.label}


def iqm(scores: Sequence[float]) -> float:
    """Interquartile mean of plain numbers."""
    return float(interquartile_mean(np.asarray(scores, float)))


def runs_table(runs: Sequence[Found]) -> Table:
    """Every run, and why it is not finished."""
    rows = [
        {
            "run": run.job.name,
            "algo": run.job.label,
            "sees": run.job.sees,
            "task": run.job.config.task,
            "seed": run.job.config.seed,
            "state": run.state,
            "score": run.score,
            "episodes": 0 if run.judged is None else len(run.judged.returns),
            "error": run.error,
        }
        for run in runs
    ]
    finished = sum(row["state"] == "finished" and not row["error"] for row in rows)
    about = f"{finished} of {len(rows)} runs are finished and judged" + (
        "." if finished == len(rows) else "; the others:"
    )
    columns = (
        Column("run", "run"),
        Column("algo", ""),
        Column("sees", ""),
        Column("task", ""),
        Column("seed", ""),
        Column("state", "state"),
        Column("score", ""),
        Column("episodes", ""),
        Column("error", "error"),
    )
    return Table("runs", "Runs", about, columns, rows)


def unfinished(table: Table) -> Table:
    """What readers are shown of `runs_table`."""
    rows = [row for row in table.rows if row["state"] != "finished" or row["error"]]
    return Table(table.name, table.title, table.about, table.columns, rows)


def returns_table(groups: Sequence[Group], episodes: int) -> Table:
    """Interquartile mean of the final evaluation over seeds."""
    rows = []
    for group in groups:
        scores, ends = group.scores, interval([group.scores]) if group.scores else None
        judged = [run.judged for run in group.runs if run.judged is not None]
        own = [each.own for each in judged if each.own is not None]
        row = _who(group) | {"seeds": len(scores), "episodes": sum(len(each.returns) for each in judged)}
        row |= {"iqm": iqm(scores) if scores else None, "own": float(np.mean(own)) if own else None}
        row |= {"low": ends[0] if ends else None, "high": ends[1] if ends else None}
        row |= {"mean": float(np.mean(scores)) if scores else None}
        row |= {"std": float(np.std(scores, ddof=1)) if len(scores) > 1 else None}
        rows.append(row)
    _rank(rows, "iqm", ("task", "sees"))
    about = (
        f"Each policy plays the same layouts, which neither trained nor chose it ({episodes} of them but in SLOT). The "
        "score of a run is its mean return; IQM is the interquartile mean over seeds (up to three seeds: the mean) "
        "with a 95 % bootstrap interval; std is that of the scores. The interval is about other trainings on "
        f"these layouts, not about other layouts. {_alone(groups)}{SEPARATE} Own layout: the return on the only layout "
        "that a policy was made for."
    )
    columns = (
        *WHO,
        Column("rank", "rank", "d"),
        Column("seeds", "seeds", "d"),
        Column("episodes", "episodes", "d"),
        Column("iqm", "IQM", ".1f"),
        Column("low", "low", ".1f"),
        Column("high", "high", ".1f"),
        Column("mean", "mean", ".1f"),
        Column("std", "std", ".1f"),
        Column("own", "own layout", ".1f"),
    )
    return Table("returns", "Final evaluation", about, columns, rows)


def _alone(groups: Sequence[Group]) -> str:
    """Which algorithms have a single run, in words."""
    labels = ", ".join(dict.fromkeys(group.label for group in groups if group.untrained))
    return f"Nothing is learned by {labels}: one run for all seeds. " if labels else ""


def aggregate_table(groups: Sequence[Group]) -> Table:
    """Interquartile mean of normalised scores over tasks and seeds."""
    tasks = [task for task in dict.fromkeys(group.task for group in groups) if task in paper.REST]
    rows = []
    for sees, label in dict.fromkeys((group.sees, group.label) for group in groups):
        mine = [each for each in groups if (each.sees, each.label) == (sees, label) and each.task in paper.REST]
        strata = [[paper.normalised(each.task, score) for score in each.scores] for each in mine if each.scores]
        if not strata:
            continue
        ends = interval(strata)
        row: Row = {"sees": sees, "algo": label, "tasks": len(strata), "runs": sum(map(len, strata))}
        row |= {"iqm": iqm([score for scores in strata for score in scores])}
        row |= {"low": ends[0] if ends else None, "high": ends[1] if ends else None}
        row["all"] = len(strata) == len(tasks)
        rows.append(row)
    _rank([row for row in rows if row["all"]], "iqm", ("sees",))
    about = (
        "Interquartile mean over all runs of all tasks, with a bootstrap of trainings (not of layouts) by task "
        "(Agarwal et al., 2021), of scores on a scale where 0 is the paper's resting robot and 1 the paper's CFP at "
        "the end of its training. Ranked within what policies see, and only with a score in every task."
    )
    columns = (
        Column("sees", "sees"),
        Column("algo", "algorithm"),
        Column("rank", "rank", "d"),
        Column("tasks", "tasks", "d"),
        Column("runs", "runs", "d"),
        Column("iqm", "IQM", ".3f"),
        Column("low", "low", ".3f"),
        Column("high", "high", ".3f"),
        Column("all", ""),
    )
    return Table("aggregate", "All tasks together", about, columns, rows)


def efficiency_table(groups: Sequence[Group], tier: Particles) -> Table:
    """Steps until the evaluations of a run reach shares of the way from rest to the best that see the same.

    Args:
        groups: All; that of ``zero`` is the resting robot.
        tier: Particles that it was judged with, and with which other curves can be compared.
    """
    rest = {group.task: iqm(group.scores) for group in groups if group.algo == "zero" and group.scores}
    shown = [group for group in groups if group.curves and not group.untrained]
    best: dict[tuple[str, str], float] = {}
    for group in shown:
        if group.particles == tier:
            key = group.task, group.sees
            best[key] = max(best.get(key, -np.inf), top_of_curve(group))
    rows = []
    for group in shown:
        floor = rest.get(group.task)
        top = best[group.task, group.sees] if group.particles == tier else None
        row = _who(group) | {"seeds": len(group.curves), "rest": floor, "best": top}
        rows.append(row if floor is None or top is None else row | _reached(group, floor, top))
    about = (
        "Environment steps until a run's own evaluation first reaches a share of the way from a resting robot (the "
        "final evaluation of zero) to the highest point of any mean curve among the algorithms that see the same in "
        "this task: median of the seeds that get there, and how many do. No entry where no curve rises above rest."
    )
    if unknown := ", ".join(dict.fromkeys(group.task for group in shown if group.task not in rest)):
        about += f" Rest was not measured in {unknown}: add zero to --algos."
    if others := ", ".join(dict.fromkeys(group.label for group in shown if group.particles != tier)):
        about += f" None for {others}, evaluated in training with other particles than those that are judged, {tier}."
    parts = (
        (Column(f"steps_{s:.0%}", f"steps to {s:.0%}", ",.0f"), Column(f"reached_{s:.0%}", "seeds")) for s in SHARES
    )
    ends = Column("rest", "rest", ".1f"), Column("best", "best", ".1f")
    columns = (*WHO, *ends, *(column for part in parts for column in part), Column("seeds", ""))
    return Table("efficiency", "Sample efficiency", about, columns, rows)


def _reached(group: Group, floor: float, top: float) -> Row:
    """When the curves of a group reach the shares of a way, and how many do."""
    row: Row = {}
    for share in SHARES if top > floor else ():
        reached = [first_reach(*curve, floor + share * (top - floor)) for curve in group.curves]
        steps = [step for step in reached if step is not None]
        row |= {f"steps_{share:.0%}": float(np.median(steps)) if steps else None}
        row |= {f"reached_{share:.0%}": f"{len(steps)}/{len(group.curves)}"}
    return row


def top_of_curve(group: Group) -> float:
    """Highest point of the mean curve of a group; of any curve where the runs have no step in common."""
    _, values = common_curve(group.curves)
    if values.shape[1]:
        return float(interquartile_mean(values).max())
    return max(float(curve.max()) for _, curve in group.curves)


def cost_table(groups: Sequence[Group]) -> Table:
    """Time and memory of training."""
    rows = []
    for group in groups:
        costs, speed, config = group.costs, group.speed, group.runs[0].job.config
        if speed is None:
            continue
        tier = getattr(config, "train_particles", None)
        memories = [cost.memory / 2**20 for cost in costs if cost.memory]
        theirs = paper.COST.get(group.label, (None, None)) if group.task == "run" else (None, None)
        rows.append(
            _who(group)
            | {
                "device": "/".join(sorted({cost.device for cost in costs})),
                "particles": str(config.environment.particles if tier is None else tier),
                "robots": config.environment.num_envs,
                "steps": max(cost.reached for cost in costs),
                "minutes": sum(cost.seconds for cost in costs) / len(costs) / 60,
                "teacher": group.teaching / 60 or None,
                "teacher_steps": max(cost.taught for cost in costs) or None,
                "judging": sum(cost.judging for cost in costs) / len(costs) / 60,
                "speed": speed,
                "episode": make_spec(group.task).horizon / speed,
                "memory": max(memories, default=None),
                "paper_episode": theirs[0],
                "paper_memory": theirs[1],
            }
        )
    about = (
        "Training without its evaluations and without that of a teacher that is trained first, whose minutes stand "
        "beside: mean over seeds. An episode is the task's whole length of steps; robots that train side by side share "
        "the time. Memory is the most that a run's process held, evaluations included. Right: the paper's Table 4, one "
        "robot at full size on an RTX 4090."
    )
    columns = (
        *WHO,
        Column("device", "device"),
        Column("particles", "particles"),
        Column("robots", "robots", "d"),
        Column("steps", "steps", ",d"),
        Column("minutes", "minutes", ".1f"),
        Column("teacher", "teacher (min)", ".1f"),
        Column("teacher_steps", ""),
        Column("judging", "evaluations (min)", ".1f"),
        Column("speed", "steps/s", ".1f"),
        Column("episode", "s/episode", ".1f"),
        Column("memory", "MiB", ".0f"),
        Column("paper_episode", "paper s/episode", ".0f"),
        Column("paper_memory", "paper MB", ".0f"),
    )
    return Table("cost", "Cost", about, columns, rows)


def success_table(groups: Sequence[Group]) -> Table:
    """Share of successful episodes."""
    rows = []
    for group in groups:
        judged = [run.judged for run in group.runs if run.judged is not None and run.judged.successes is not None]
        if not judged:
            continue
        trials, successes = sum(len(each.returns) for each in judged), sum(each.successes or 0 for each in judged)
        low, high = wilson(successes, trials)
        theirs = paper.SUCCESS.get(group.label) if group.task == "slot" else None
        row = _who(group) | {"successes": successes, "episodes": trials, "rate": successes / trials}
        rows.append(row | {"low": low, "high": high, "paper": theirs})
    about = (
        "Episodes that end in success as the task defines it, of all seeds together, with Wilson's 95 % interval, "
        "which takes episodes as independent though those of one seed share a policy. The paper reports SLOT only."
    )
    columns = (
        *WHO,
        Column("successes", "successes", "d"),
        Column("episodes", "episodes", "d"),
        Column("rate", "rate", ".1%"),
        Column("low", "low", ".1%"),
        Column("high", "high", ".1%"),
        Column("paper", "paper", ".1%"),
    )
    return Table("success", "Success", about, columns, rows)


def robustness_table(groups: Sequence[Group]) -> Table:
    """Ratio of returns under faults to the unperturbed return."""
    rows = []
    for group in groups:
        cases = _cases(group)
        # What was tried with nobody, such as gravity where there is none, has no row.
        others = (each for other in groups if other.task == group.task for each in _cases(other))
        tried = {case for each in others for case, value in each.items() if value is not None}
        for case in list(cases[0])[1:] if cases else []:
            if case not in tried:
                continue
            pairs = [(each[case], each["unperturbed"]) for each in cases]
            ratios = [value / base for value, base in pairs if value is not None and base is not None and base > 0]
            row = _who(group) | {"case": case, "seeds": len(ratios), "paper": _fault(group, case)}
            row |= {"ratio": float(np.mean(ratios)) if ratios else None}
            rows.append(row | {"low": min(ratios, default=None), "high": max(ratios, default=None)})
    about = (
        "Return under a disturbance as a share of the unperturbed one on the same layouts: mean, lowest and highest of "
        "the seeds whose unperturbed return is positive; no ratio where a case changes nothing, as lost pixels "
        "for a policy that looks at none. The paper's figures are those of CFP."
    )
    columns = (
        *WHO,
        Column("case", "case"),
        Column("seeds", "seeds", "d"),
        Column("ratio", "ratio", ".3f"),
        Column("low", "lowest", ".3f"),
        Column("high", "highest", ".3f"),
        Column("paper", "paper", ".3f"),
    )
    return Table("robustness", "Robustness", about, columns, rows)


def _cases(group: Group) -> list[dict[str, float | None]]:
    return [run.judged.cases for run in group.runs if run.judged is not None]


def _fault(group: Group, case: str) -> float | None:
    if group.label != "cfp" or group.task not in paper.FAULTS:
        return None
    seen, acted = paper.FAULTS[group.task]
    return {"observation dropout 20%": seen, "action dropout 20%": acted}.get(case)


def paper_table(groups: Sequence[Group]) -> Table:
    """Our returns beside the paper's."""
    rows = []
    for group in groups:
        config = group.runs[0].job.config
        theirs, grid = paper.curve(group.label, group.task), config.resolution(len(config.ends()) - 1)
        expert = paper.EXPERTS.get(group.task, {}).get(grid) if config.algo in ("coarse", "fine") else None
        if not group.scores or (theirs is None and expert is None and group.task not in paper.REST):
            continue
        row = _who(group) | {"ours": iqm(group.scores), "ours_steps": config.ends()[-1], "grid": grid}
        row |= {"rest": paper.REST.get(group.task), "paper_steps": paper.CURVES[group.task][0] if theirs else None}
        row |= {"paper": theirs[0] if theirs else None, "band": theirs[1] if theirs else None}
        rows.append(row | {"expert": expert[0] if expert else None})
    about = (
        "Ours: interquartile mean of the final evaluation. Paper: mean of the last tenth of its training curves and "
        "half the width of their band, three seeds, full size; expert: its best policy at this action grid; rest: a "
        "robot that does not move, in the reference environment. Mind the steps."
    )
    columns = (
        *WHO,
        Column("grid", "grid", "d"),
        Column("ours_steps", "our steps", ",d"),
        Column("ours", "ours", ".0f"),
        Column("paper", "paper", ".0f"),
        Column("band", "±", ".0f"),
        Column("paper_steps", "paper's steps", ",d"),
        Column("expert", "expert", ".0f"),
        Column("rest", "rest", ".0f"),
    )
    return Table("paper", "Beside the paper", about, columns, rows)


def _rank(rows: Iterable[Row], key: str, within: tuple[str, ...]) -> None:
    """Put ``rank`` into rows that have a value, 1 for the highest, among those that agree in ``within``."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        if row[key] is not None:
            groups.setdefault(tuple(row[name] for name in within), []).append(row)
    for members in groups.values():
        for row in members:
            row["rank"] = 1 + sum(other[key] > row[key] for other in members)
