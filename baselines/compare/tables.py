"""The tables of a comparison."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from baselines.compare import paper
from baselines.compare.results import Group, RunResult
from baselines.compare.stats import align_curves, first_step_at, interquartile_mean, score_interval, wilson_interval
from cfp.sections import Particles
from cfp.tables import Column, Row, Table, columns, make_row
from dittogym import make_spec

#: Fractions of the way from a resting robot to the best curve, for sample efficiency.
MILESTONES = (0.5, 0.75, 0.9)
GROUP = (
    Column("task", "task", value=lambda group: group.task),
    Column("sees", "observes", value=lambda group: group.sees),
    Column("algo", "algorithm", value=lambda group: group.label),
)


def rank(rows: Iterable[dict[str, Any]], within: tuple[str, ...], score: str = "iqm") -> None:
    """Add ``rank`` to rows with a ``score``, 1 for the highest, among those that agree in the columns ``within``."""
    rows = [row for row in rows if row[score] is not None]
    for row in rows:
        rivals = [other for other in rows if all(other[name] == row[name] for name in within)]
        row["rank"] = 1 + sum(other[score] > row[score] for other in rivals)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _own_layout(group: Group) -> float | None:
    return _mean([each.own_layout for each in group.evaluations if each.own_layout is not None])


def _labels(groups: Iterable[Group]) -> str:
    return ", ".join(dict.fromkeys(group.label for group in groups))


RUNS = (
    Column("run", "run", value=lambda run: run.job.name),
    Column("algo", value=lambda run: run.job.label),
    Column("sees", value=lambda run: run.job.sees),
    Column("task", value=lambda run: run.job.config.task),
    Column("seed", value=lambda run: run.job.config.seed),
    Column("state", "state", value=lambda run: run.state),
    Column("score", value=lambda run: run.evaluation and run.evaluation.mean),
    Column("episodes", value=lambda run: len(run.evaluation.returns) if run.evaluation else 0),
    Column("error", "error", value=lambda run: run.error),
)


def runs_table(runs: Sequence[RunResult]) -> Table:
    """Every run, and why it is not finished."""
    rows = [make_row(RUNS, run) for run in runs]
    others = len(unfinished(rows))
    description = f"{len(rows) - others} of {len(rows)} runs are finished and evaluated{'; the others:' * bool(others)}"
    return Table("runs", "Runs", description if others else f"{description}.", RUNS, rows)


def unfinished(rows: Sequence[Row]) -> list[Row]:
    """Rows of `runs_table` that the reader should look at."""
    return [row for row in rows if row["state"] != "finished" or row["error"]]


RETURNS = (
    *GROUP,
    Column("rank", "rank", "d"),
    Column("seeds", "seeds", "d", lambda group: len(group.scores)),
    Column("episodes", "episodes", "d", lambda group: sum(len(each.returns) for each in group.evaluations)),
    Column("iqm", "IQM", ".1f", lambda group: group.iqm),
    Column("low", "low", ".1f", lambda group: group.interval[0]),
    Column("high", "high", ".1f", lambda group: group.interval[1]),
    Column("mean", "mean", ".1f", lambda group: _mean(group.scores)),
    Column("std", "std", ".1f", lambda group: float(np.std(group.scores, ddof=1)) if len(group.scores) > 1 else None),
    Column("own", "own layout", ".1f", _own_layout),
)


def returns_table(groups: Sequence[Group], episodes: int) -> Table:
    """Interquartile mean of the final evaluation over seeds."""
    rows = [make_row(RETURNS, group) for group in groups]
    rank(rows, ("task", "sees"))
    untrained = _labels(group for group in groups if group.job.untrained)
    description = (
        f"Each policy plays the same layouts, which neither trained nor selected it ({episodes}, more in SLOT). "
        "The score of a run is its mean return; IQM is the interquartile mean over seeds (up to three seeds: the mean) "
        "with a 95 % bootstrap interval; std is that of the scores. The interval is about other trainings on these "
        f"layouts, not about other layouts. {f'One run stands for all seeds of {untrained}. ' if untrained else ''}"
        "Ranks are within a task and among policies that observe the same: image, state, simulator and nothing are "
        "never ranked together. Own layout: the return on the only layout that a policy was made for."
    )
    return Table("returns", "Final evaluation", description, RETURNS, rows)


AGGREGATE = (
    *columns(sees="observes", algo="algorithm"),
    *columns("d", rank="rank", tasks="tasks", runs="runs"),
    *columns(".3f", iqm="IQM", low="low", high="high"),
    Column("all"),
)


def aggregate_table(groups: Sequence[Group]) -> Table:
    """Interquartile mean of normalised scores over tasks and seeds."""
    groups = [group for group in groups if group.task in paper.REST]
    strata: dict[tuple[str, str], list[list[float]]] = {}
    for group in groups:
        if group.scores:
            scores = [paper.normalised(group.task, score) for score in group.scores]
            strata.setdefault((group.sees, group.label), []).append(scores)
    rows, tasks = [], {group.task for group in groups}
    for (sees, label), by_task in strata.items():
        scores, (low, high) = [score for scores in by_task for score in scores], score_interval(by_task)
        row = {"sees": sees, "algo": label, "tasks": len(by_task), "runs": len(scores), "low": low, "high": high}
        rows.append(row | {"iqm": float(interquartile_mean(scores)), "all": len(by_task) == len(tasks)})
    rank([row for row in rows if row["all"]], ("sees",))
    description = (
        "Interquartile mean over all runs of all tasks, with a bootstrap of trainings (not of layouts) by task "
        "(Agarwal et al., 2021), of scores on a scale where 0 is the paper's resting robot and 1 the paper's CFP at "
        "the end of its training. Ranked among policies that observe the same, and only with a score in every task."
    )
    return Table("aggregate", "All tasks together", description, AGGREGATE, rows)


EFFICIENCY = (
    *GROUP,
    *columns(".1f", rest="rest", best="best"),
    *(
        column
        for part in MILESTONES
        for column in (
            Column(f"steps_{part:.0%}", f"steps to {part:.0%}", ",.0f"),
            Column(f"reached_{part:.0%}", "seeds"),
        )
    ),
    Column("seeds"),
)


def efficiency_table(groups: Sequence[Group], particles: Particles) -> Table:
    """Steps until evaluations with ``particles`` particles reach the milestones between rest and the best curve."""
    rest = {group.task: group.iqm for group in groups if group.job.config.algo == "zero"}
    trained = [group for group in groups if group.curves and not group.job.untrained]
    best: dict[tuple[str, str], float] = {}
    for group in trained:
        if group.particles == particles:
            key = group.task, group.sees
            best[key] = max(best.get(key, -np.inf), highest_point(group))
    rows = []
    for group in trained:
        low, high = rest.get(group.task), best[group.task, group.sees] if group.particles == particles else None
        row = make_row(GROUP, group) | {"seeds": len(group.curves), "rest": low, "best": high}
        if low is not None and high is not None and high > low:
            row |= _milestones(group, low, high)
        rows.append(row)
    description = (
        "Environment steps until a run's own evaluation first reaches a fraction of the way from a resting robot (the "
        "final evaluation of zero) to the highest point of any mean curve among the algorithms that observe the same "
        "in this task: median of the seeds that reach it, and their number. No entry where no curve rises above rest."
    )
    if unknown := ", ".join(dict.fromkeys(group.task for group in trained if rest.get(group.task) is None)):
        description += f" The return at rest is unknown in {unknown}: add zero to --algos."
    if others := _labels(group for group in trained if group.particles != particles):
        description += f" No entry for {others}, evaluated during training with particles other than {particles}."
    return Table("efficiency", "Sample efficiency", description, EFFICIENCY, rows)


def _milestones(group: Group, low: float, high: float) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for part in MILESTONES:
        steps = [first_step_at(curve, low + part * (high - low)) for curve in group.curves]
        reached = [step for step in steps if step is not None]
        row[f"steps_{part:.0%}"] = float(np.median(reached)) if reached else None
        row[f"reached_{part:.0%}"] = f"{len(reached)}/{len(steps)}"
    return row


def highest_point(group: Group) -> float:
    """Highest point of the mean curve of a group; of any curve if the runs have no step in common."""
    _, values = align_curves(group.curves)
    if values.shape[1]:
        return float(interquartile_mean(values).max())
    return max(float(curve.max()) for _, curve in group.curves)


def _paper_cost(group: Group) -> tuple[float, float] | tuple[None, None]:
    return paper.COST.get(group.label, (None, None)) if group.task == "run" else (None, None)


def _train_particles(group: Group) -> str:
    return str(getattr(group.job.config, "train_particles", None) or group.particles)


def _peak_memory(group: Group) -> float | None:
    return max((cost.memory / 2**20 for cost in group.costs if cost.memory), default=None)


COST = (
    *GROUP,
    Column("device", "device", value=lambda group: "/".join(sorted({cost.device for cost in group.costs}))),
    Column("particles", "particles", value=_train_particles),
    Column("robots", "robots", "d", lambda group: group.job.config.environment.num_envs),
    Column("steps", "steps", ",d", lambda group: max(cost.last_step for cost in group.costs)),
    Column("minutes", "minutes", ".1f", lambda group: group.mean_cost("seconds") / 60),
    Column("teacher", "teacher (min)", ".1f", lambda group: group.mean_cost("teacher_seconds") / 60 or None),
    Column("teacher_steps", value=lambda group: max(cost.teacher_steps for cost in group.costs) or None),
    Column("evaluation_minutes", "evaluations (min)", ".1f", lambda group: group.mean_cost("evaluation_seconds") / 60),
    Column("speed", "steps/s", ".1f", lambda group: group.speed),
    Column("episode", "s/episode", ".1f", lambda group: make_spec(group.task).horizon / group.speed),
    Column("memory", "MiB", ".0f", _peak_memory),
    Column("paper_episode", "paper s/episode", ".0f", lambda group: _paper_cost(group)[0]),
    Column("paper_memory", "paper MB", ".0f", lambda group: _paper_cost(group)[1]),
)


def cost_table(groups: Sequence[Group]) -> Table:
    """Time and memory of training."""
    description = (
        "Training without its evaluations and without that of a teacher that is trained first, which has columns of "
        "its own: mean over seeds. An episode is the task's whole length of steps; robots that train side by side "
        "share the time. Memory is the most that a run's process held, evaluations included. Right: the paper's Table "
        "4, one robot with full particles on an RTX 4090."
    )
    return Table("cost", "Cost", description, COST, [make_row(COST, group) for group in groups if group.costs])


SUCCESS = (
    *GROUP,
    *columns("d", successes="successes", episodes="episodes"),
    *columns(".1%", rate="rate", low="low", high="high", paper="paper"),
)


def success_table(groups: Sequence[Group]) -> Table:
    """Share of successful episodes."""
    rows = []
    for group in groups:
        counts = [(each.successes, len(each.returns)) for each in group.evaluations if each.successes is not None]
        if not counts:
            continue
        successes, episodes = (sum(values) for values in zip(*counts, strict=True))
        low, high = wilson_interval(successes, episodes)
        published = paper.SUCCESS.get(group.label) if group.task == "slot" else None
        row = make_row(GROUP, group) | {"successes": successes, "episodes": episodes, "rate": successes / episodes}
        rows.append(row | {"low": low, "high": high, "paper": published})
    description = (
        "Episodes that end in success as the task defines it, of all seeds together, with Wilson's 95 % interval, "
        "which takes episodes as independent although those of one seed share a policy. The paper reports SLOT only."
    )
    return Table("success", "Success", description, SUCCESS, rows)


ROBUSTNESS = (
    *GROUP,
    *columns("", case="case"),
    *columns("d", seeds="seeds"),
    *columns(".3f", ratio="ratio", low="lowest", high="highest", paper="paper"),
)


def robustness_table(groups: Sequence[Group]) -> Table:
    """Ratio of the returns in disturbed cases to the unperturbed return."""
    effective = {
        (group.task, case)
        for group in groups
        for evaluation in group.evaluations
        for case, value in evaluation.cases.items()
        if value is not None
    }
    rows = []
    for group in groups:
        for case in group.evaluations[0].cases if group.evaluations else ():
            if (group.task, case) not in effective:
                continue  # such as gravity in a task without it
            pairs = [(each.cases[case], each.mean) for each in group.evaluations]
            ratios = [value / base for value, base in pairs if value is not None and base > 0]
            row = make_row(GROUP, group) | {"case": case, "seeds": len(ratios), "paper": _published_ratio(group, case)}
            row |= {"ratio": _mean(ratios), "low": min(ratios, default=None), "high": max(ratios, default=None)}
            rows.append(row)
    description = (
        "Return in a disturbed case divided by the unperturbed one on the same layouts: mean, lowest and highest of "
        "the seeds whose unperturbed return is positive; no ratio where a case changes nothing, such as lost pixels "
        "for a policy that does not observe the image. The paper's figures are those of CFP."
    )
    return Table("robustness", "Robustness", description, ROBUSTNESS, rows)


def _published_ratio(group: Group, case: str) -> float | None:
    if group.label != "cfp" or group.task not in paper.DROPOUT_RATIOS:
        return None
    observation, action = paper.DROPOUT_RATIOS[group.task]
    return {"observation dropout 20%": observation, "action dropout 20%": action}.get(case)


PAPER = (
    *GROUP,
    *columns("d", grid="grid"),
    *columns(",d", ours_steps="our steps"),
    *columns(".0f", ours="ours", paper="paper", band="±"),
    *columns(",d", paper_steps="paper's steps"),
    *columns(".0f", expert="expert", rest="rest"),
)


def paper_table(groups: Sequence[Group]) -> Table:
    """Our returns beside the paper's."""
    rows = []
    for group in groups:
        config, iqm, rest = group.job.config, group.iqm, paper.REST.get(group.task)
        grid, published = config.resolution(len(config.ends())), paper.curve(group.label, group.task)
        expert = paper.EXPERTS.get(group.task, {}).get(grid) if config.algo in ("coarse", "fine") else None
        if iqm is None or (published is None and expert is None and rest is None):
            continue
        row = make_row(GROUP, group) | {"grid": grid, "ours": iqm, "ours_steps": config.ends()[-1], "rest": rest}
        if published is not None:
            row |= {"paper": published[0], "band": published[1], "paper_steps": paper.STEPS[group.task]}
        rows.append(row | {"expert": expert[0] if expert else None})
    description = (
        "Ours: interquartile mean of the final evaluation. Paper: mean of the last tenth of its training curves and "
        "half the width of their band, three seeds, full particles; expert: its best policy on this action grid; rest: "
        "a robot that does not move, in the reference environment. The numbers of steps differ."
    )
    return Table("paper", "Beside the paper", description, PAPER, rows)
