"""Writes the tables of the documents into their pages, from committed results and from the code.

A table stands between the comments ``<!-- table: NAME ARGUMENTS -->`` and ``<!-- end of table -->``. Run
``python docs/tables.py`` after results or the code have changed; a test checks that all tables are current.
"""

from __future__ import annotations

import csv
import json
import math
import pkgutil
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from scipy import stats

import dittogym
from baselines.compare import paper
from cfp.robustness import COLUMNS, DISTURBANCES, KEY, MATTER, OWN_START, UNDISTURBED, ratios
from dittogym.bodies.positions import particle_counts
from dittogym.geometry import Box, Obstacle
from dittogym.spec import BodySpec
from dittogym.tasks import headline
from torchmpm import Snow

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
OBSERVES = ("image", "state", "simulator", "nothing")
BLOCK = re.compile(r"(<!-- table: ([^\n]+) -->\n)(?:.*\n)*?(<!-- end of table -->)")
INF = math.inf
#: Where algorithms say what they log.
METRICS = {
    "all": ("cfp.experiment.callbacks.LOG_METRICS", "cfp.experiment.callbacks.EVALUATION_METRICS"),
    "`cfp-analytic`": ("cfp.analytic.learner.METRICS",),
    "`cfp-sac`": ("cfp.sac.learner.METRICS",),
    "`shac`": ("baselines.shac.METRICS",),
    "`distill`": ("baselines.distillation.learner.METRICS",),
    "`gradient`": ("baselines.trajectory.METRICS",),
    "`mpc`, `cem`": ("baselines.planning.mpc.METRICS",),
}
Row = dict[str, str]


def read(name: str) -> list[Row]:
    """Rows of a CSV file of this folder."""
    with (DOCS / name).open(newline="") as file:
        return list(csv.DictReader(file))


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (columns, ["---"] * len(columns), *rows))


def number(text: str) -> str:
    """A return or a count, with thousands separated."""
    return f"{float(text.replace(',', '')):,.0f}" if text else ""


def name_of(task: str) -> str:
    """Name of a task as it is written in texts."""
    return headline(task)[0]


# Results


def evaluated(task: str, policy: str, case: str, particles: str, noise: str = "") -> Row:
    """The row of an evaluation by `torchmpm robustness`, with empty cells if there is none."""
    key = task, policy, case, particles
    rows = (row for row in read("evaluations.csv") if tuple(row[name] for name in KEY[1:5]) == key)
    return next((row for row in rows if noise in ("", row["noise"])), dict.fromkeys(COLUMNS, ""))


def estimate(row: Row) -> str:
    """Mean return with half its 95 % interval, on one line."""
    words = (number(row["mean"]), "±", number(row["interval"])) if row["interval"] else (number(row["mean"]),)
    return "\N{NO-BREAK SPACE}".join(words)


#: Policies that were preferred to others by episodes from their own start that are in the table, which flatters them.
CHOSEN_ON_OWN_START = ("dig", "grow", "kick", "obstacle", "shapematch")


def compared(row: Row, theirs: int) -> str:
    """The same, bold if the lower end of the interval is above the paper's return, and nothing was chosen by it."""
    fair = row["interval"] and row["policy"] not in CHOSEN_ON_OWN_START
    return f"**{estimate(row)}**" if fair and float(row["mean"]) - float(row["interval"]) > theirs else estimate(row)


def share(text: str) -> str:
    """A share in percent."""
    return f"{float(text):.0%}" if text else "–"


def results() -> str:
    """All tasks: zero and random actions, the policies of the package, and the paper's."""
    rows = []
    for training in read("training.csv"):
        task, policy = training["task"], training["policy"]
        full, lite = evaluated(task, policy, OWN_START, "full"), evaluated(task, policy, UNDISTURBED, "lite")
        theirs, several = paper.CURVES[task][0][0], int(training["seeds"]) > 1
        rows.append(
            [
                name_of(task) + (f", `{policy}`" if policy != task else ""),
                number(evaluated(task, "zero", UNDISTURBED, "lite")["mean"]),
                f"{theirs:,}",
                compared(full, theirs),
                share(full["success"]),
                estimate(lite),
                share(lite["success"]),
                training["minutes"],
                training["seeds"] + f": {number(training['lowest'])} to {number(training['highest'])}" * several,
            ]
        )
    own = "own start, full: return", "success", "varied starts, lite: return", "success"
    return markdown(("", "zero actions", "paper's CFP", *own, "minutes on one core", "trainings"), rows)


#: Cases of the protocol behind each of the six ratios.
RATIOS = {
    "missing actions": ("action dropout",),
    "missing pixels": ("observation dropout",),
    "latency": ("latency",),
    "noise": ("action noise",),
    "matter": tuple(case for case, options in DISTURBANCES.items() if options.keys() & {*MATTER}),
    "full particles": (UNDISTURBED,),
}


def evaluations() -> str:
    """What `torchmpm robustness` has measured of each policy, with ratios (and plain quotients); the paper's CFP."""
    rows = read("evaluations.csv")

    def pair(first: Row, second: Row, column: str) -> str:
        return f"{share(first[column])} / {share(second[column])}"

    def ratio(cases: Sequence[Row]) -> str:
        """The lowest ratio of some cases, and its quotient."""
        pairs = [values for row in cases if row["mean"] and None not in (values := ratios(row, rows))]
        return "{:.2f} ({:.2f})".format(*min(pairs)) if pairs else ""

    lines = []
    found = dict.fromkeys((row["task"], row["policy"], row["noise"]) for row in rows if row["sha256"])
    for task, policy, noise in sorted(found, key=lambda key: [*dittogym.TASKS].index(key[0])):
        lite, full = (evaluated(task, policy, UNDISTURBED, particles, noise) for particles in ("lite", "full"))
        lines.append(
            [
                name_of(task),
                f"`{policy}`" + ", mean action" * (noise == "without"),
                estimate(evaluated(task, "random", UNDISTURBED, "lite")),
                *(estimate(row) for row in (lite, full)),
                pair(lite, full, "success"),
                pair(lite, full, "success_whole"),
                pair(lite, full, "piece"),
                *(
                    ratio(
                        [
                            evaluated(task, policy, case, "full" if case == UNDISTURBED else "lite", noise)
                            for case in cases
                        ]
                    )
                    for cases in RATIOS.values()
                ),
            ]
        )
    heads = ("", "policy", "random actions", "return, lite", "full")
    return markdown((*heads, "success, lite / full", "and not torn", "one piece", *RATIOS), lines)


def dropout() -> str:
    """What missing actions and pixels leave of the returns of the paper's CFP and of the policies of the package."""
    rows, lines = read("evaluations.csv"), []
    for i, case in enumerate(("action dropout", "observation dropout")):
        found = {task: evaluated(task, task, case, "lite") for task in dittogym.TASKS}
        left = {task: ratios(row, rows)[1] if row["mean"] else None for task, row in found.items()}
        what = list(RATIOS)[i]
        lines.append([f"{what}, paper's CFP", *(f"{paper.DROPOUT[task][i]:.2f}" for task in dittogym.TASKS)])
        lines.append([f"{what}, `cfp.load(task)`", *("" if q is None else f"{q:.2f}" for q in left.values())])
    return markdown(("", *map(name_of, dittogym.TASKS)), lines)


def shipped() -> list[Row]:
    """Rows of `evaluations.csv` about the task's own starts and noisy actions, in the form of `returns.csv`."""
    own = (row for row in read("evaluations.csv") if (row["case"], row["noise"]) == (OWN_START, "with"))
    first = (row for row in own if row["policy"] == row["task"])
    return [row | {"algorithm": "`cfp.load(task)`", "observes": "image"} for row in first]


def returns() -> str:
    """Mean returns of all algorithms in all tasks with full particles, from the evaluations with the most episodes."""
    cells: dict[tuple[str, str], dict[str, list[Row]]] = {}
    for row in (*shipped(), *read("returns.csv")):
        label = re.sub(r", .*", "`", row["algorithm"])
        label = "`distill`" if "distill" in row["algorithm"] else label.replace("``", "`").strip()
        if row["particles"] == "full" and "target" not in row["algorithm"]:
            cells.setdefault((row["observes"], label), {}).setdefault(row["task"], []).append(row)

    def cell(rows: list[Row]) -> str:
        most = max((int(row["episodes"] or 0) for row in rows), default=0)
        return " / ".join(number(row["mean"]) for row in rows if int(row["episodes"] or 0) == most)

    return markdown(
        ("Observes", "Algorithm", *map(name_of, dittogym.TASKS)),
        (
            [*key, *(cell(cells[key].get(task, [])) for task in dittogym.TASKS)]
            for key in sorted(cells, key=lambda key: OBSERVES.index(key[0]))
        ),
    )


def rewards() -> str:
    """Coarse stages that learned from rewards alone, with full particles; the paper's coarse policy and CFP."""
    rows = [row for row in read("returns.csv") if "`cfp-sac`" in row["algorithm"] and row["particles"] == "full"]
    lines = []
    for row in sorted((row for row in rows if row["std"]), key=lambda row: [*dittogym.TASKS].index(row["task"])):
        count = int(row["episodes"])
        interval = float(stats.t.ppf(0.975, count - 1)) * float(row["std"]) / math.sqrt(count - 1)
        (theirs, _), (coarse, _) = paper.CURVES[row["task"]][:2]
        lines.append(
            [
                name_of(row["task"]),
                number(row["steps"]),
                row["minutes"],
                estimate(row | {"interval": f"{interval}"}),
                share(row["success"]),
                row["episodes"],
                f"{coarse:,}",
                f"{theirs:,}",
            ]
        )
    heads = ("steps", "minutes on one core", "return, full particles", "success", "episodes")
    return markdown(("", *heads, "paper's coarse policy", "paper's CFP"), lines)


def published() -> str:
    """The paper's training returns with full particles."""
    rows = (
        [f"`{name}`", *(f"{paper.CURVES[task][i][0]:,}" for task in paper.CURVES)]
        for i, name in enumerate(paper.COLUMNS)
    )
    return markdown(("Algorithm", *map(name_of, paper.CURVES)), rows)


def pivot(
    rows: Iterable[Row], index: Sequence[str], columns: Sequence[str], value: str
) -> tuple[list[tuple[str, ...]], list[list[str]]]:
    """Heads and lines of a table: a line for each value of some columns, a cell, maybe a list, for each of others."""
    lines: dict[tuple[str, ...], dict[tuple[str, ...], list[str]]] = {}
    for row in rows:
        line = lines.setdefault(tuple(row[key] for key in index), {})
        line.setdefault(tuple(row[key] for key in columns), []).append(row[value])
    heads = sorted({head for line in lines.values() for head in line})
    return heads, [[*key, *(", ".join(line.get(head, [])) for head in heads)] for key, line in lines.items()]


def ablation_gradients() -> str:
    """Final returns of the learner from gradients while one option is changed at a time, on SHAPE MATCH."""
    _, lines = pivot((row for row in read("analytic-shapematch.csv") if row["final"]), ("part", "value"), (), "final")
    options: dict[str, list[str]] = {}
    for part, value, finals in lines:
        options.setdefault(part, []).append(f"{value}: {finals}")
    return markdown(("Option", "Value: returns"), ([part, "; ".join(values)] for part, values in options.items()))


def ablation_rewards() -> str:
    """Returns of the learner from rewards with each option left out, over ten episodes."""
    rows = [row | {"mean": number(row["mean"])} for row in read("rewards-ablation.csv") if row["episodes"]]
    heads, lines = pivot(rows, ("change",), ("task",), "mean")
    return markdown(("Left out or changed", *(name_of(task) for (task,) in heads)), lines)


def best_rewards() -> str:
    """Best policies of the coarse stage of the learner from rewards, over ten episodes, by seed."""
    rows = [row for row in read("rewards-tasks.csv") if row["episodes"]]
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    return markdown(
        ("", *map(name_of, tasks)),
        [["return, seeds 0, 1, ...", *(", ".join(number(r["mean"]) for r in rows if r["task"] == t) for t in tasks)]],
    )


def costs() -> str:
    """Cost of a step of every task, with full and with lite particles."""
    rows = read("task-costs.csv")
    columns = list(rows[0])[2:]  # after the task and the name of the particle count
    pairs = zip(rows[::2], rows[1::2], strict=True)
    lines = ([name_of(full["task"]), *(f"{full[key]} / {lite[key]}" for key in columns)] for full, lite in pairs)
    return markdown(("task", "particles", *columns[1:]), lines)


#: In place of speeds on a GPU until there are results.
NO_CARD = "No card has run `make gpu` yet.\n"


def gpu_run() -> tuple[str, dict[str, Any]] | None:
    """The last results of `make gpu`: the card with the date, and the rows of the stage `speed` by their names."""
    files = (ROOT / "benchmarks/gpu").glob("*.json")
    found = max((json.loads(path.read_text()) for path in files), key=lambda result: result["date"], default=None)
    if found is None:
        return None
    card = next(row["figures"]["card"] for row in found["rows"] if row["check"] == "versions")
    speed = {row["check"]: row for row in found["rows"] if row["stage"] == "speed" and not row["wrong"]}
    return f"{card}, {found['date']}", speed


def rate(row: dict[str, Any] | None, name: str) -> str:
    """A speed of a row, or nothing."""
    return number(str(row["figures"].get(f"{name} (steps/s)", ""))) if row else ""


def gpu() -> str:
    """Environment steps a second on the card that ran `make gpu` last."""
    if (run := gpu_run()) is None:
        return NO_CARD
    (card, speed), columns = run, ("physics", "physics with gradient", "env.step", "env.step with gradient")
    rows = [
        [f"{name} ({row['backend']})", *(rate(row, column) for column in columns)]
        for name, row in speed.items()
        if "physics (steps/s)" in row["figures"]
    ]
    return markdown((f"Robots × particles ({card})", *columns), rows)


def gpu_line() -> str:
    """The same in a line."""
    if (run := gpu_run()) is None:
        return NO_CARD
    card, speed = run
    one, many = (speed.get(name) for name in ("1 × full", "1024 × lite"))
    cells = [rate(one, "env.step"), rate(many, "env.step"), rate(many, "env.step with gradient")]
    columns = ("RUN, steps/s", "1 robot, 22,000 particles", "1,024 robots of 2,000", "1,024 with gradients")
    return markdown(columns, [[card, *cells]])


def cuda_kernels() -> str:
    """Registers, spills and shared memory of the CUDA kernels."""
    rows = json.loads((DOCS / "cuda-kernels.json").read_text())["rows"]
    return markdown(list(rows[0]), (list(row.values()) for row in rows))


def verification() -> str:
    """Errors of the solver, with a row for each problem."""
    problems: dict[str, list[Row]] = {}
    for row in read("verification.csv"):
        problems.setdefault(row["problem"], []).append(row)

    def listed(rows: list[Row], column: str) -> str:
        return ", ".join(row[column] for row in rows if row[column])

    def sizes(rows: list[Row]) -> str:
        return f"{', '.join(row['size'].split()[0] for row in rows)} {rows[0]['size'].partition(' ')[2]}"

    return markdown(
        ("Problem", "Sizes", "Errors", "Orders"),
        ([name, sizes(rows), listed(rows, "error"), listed(rows, "order")] for name, rows in problems.items()),
    )


def metrics() -> str:
    """What trainings log, and which algorithms log it."""
    found: dict[tuple[str, str], list[str]] = {}
    for algorithms, paths in METRICS.items():
        for path in paths:
            for key, meaning in pkgutil.resolve_name(path).items():
                found.setdefault((key, meaning), []).append(algorithms)
    return markdown(
        ("Name", "Algorithms", "Meaning"),
        ([f"`{key}`", ", ".join(algorithms), meaning] for (key, meaning), algorithms in found.items()),
    )


# Tasks


def tasks() -> str:
    """A table of all tasks."""
    rows = []
    for task in dittogym.TASKS:
        spec, (_, what) = dittogym.make_spec(task), headline(task)
        link = f"[`{task}`](tasks/{task}.md)"
        grids = f"{spec.coarse}, {spec.fine}"
        rows.append([link, what, f"{spec.horizon}", grids, ", ".join(map(matter, spec.objects))])
    return markdown(("Task", "Goal", "Steps", "Action resolution: coarse, fine", "Objects"), rows)


def matter(body: BodySpec) -> str:
    """Material of an object."""
    return "soil" if isinstance(body.material, Snow) else "elastic"


def centre(place: tuple[float | None, float | None]) -> str:
    """A centre in window coordinates."""
    x, y = ("the robot's" if value is None else f"{value:g} m" for value in place)
    return f"x: {x}, y: {y}"


def constants(task: str) -> str:
    """Constants of a task."""
    spec = dittogym.make_spec(task)
    full, lite = (particle_counts(spec, tier) for tier in ("full", "lite"))
    window = spec.window
    bodies = [("robot", spec.robot), *((f"object ({matter(body)})", body) for body in spec.objects)]
    left = f"from x = {window.left:g} m" if window.follow is None else f"{window.follow:g} m behind the robot's centre"
    rows = [
        ("steps per episode; action resolution", f"{spec.horizon}; coarse {spec.coarse}, fine {spec.fine}"),
        *(
            (f"particles of the {name}, full and lite", f"{one:,} and {other:,}; {body.mass:g} kg each with full")
            for (name, body), one, other in zip(bodies, full, lite, strict=True)
        ),
        ("Lamé parameters μ, λ; yield stress", f"{spec.mu:g}, {spec.lam:g}; {spec.yield_stress:g} Pa"),
        ("muscle stress for an action of 1", f"{spec.max_actuation:g} Pa"),
        ("gravity; damping factor per 0.1 ms", f"{spec.gravity[1]:g} m/s²; {spec.damping:g}"),
        ("simulation window", left),
        ("centre of the observed region", centre(spec.view)),
        ("action patch", f"{spec.patch} nodes; centre {centre(spec.patch_centre)}"),
        ("spread limit of the robot", "none" if spec.split_limit is None else f"{spec.split_limit:g} m"),
    ]
    if spec.goal is not None:
        rows.append(("goal, drawn in the observation", f"({spec.goal[0]:g}, {spec.goal[1]:g}) m"))
    return markdown(("Constant", "Value"), rows)


def geometry(task: str) -> str:
    """Obstacles of a task: name, visibility, friction and edges."""
    return markdown(
        ("Obstacle", "In the observation", "Friction", "Edges, nodes"),
        (
            [
                obstacle.name,
                "yes" if obstacle.observed_boxes else "no",
                friction(obstacle),
                "; ".join(map(extent, obstacle.boxes)) or "the edges of the window",
            ]
            for obstacle in dittogym.make_spec(task).obstacles
        ),
    )


def friction(obstacle: Obstacle) -> str:
    """Friction of an obstacle; in the tasks only an upper side has any."""
    found = {rule.friction for rule in obstacle.velocity_rules}
    if math.inf not in found:
        return "none"
    return "no slip" if found == {math.inf} else "no slip on top"


def extent(box: Box) -> str:
    """Edges of a box in coordinates of nodes."""
    sides = (("i", box.left, box.right), ("j", box.bottom, box.top))
    return ", ".join(f"{axis} {span(128 * low, 128 * high)}" for axis, low, high in sides if low > -INF or high < INF)


def span(low: float, high: float) -> str:
    """A range."""
    if low == -INF:
        return f"≤ {high:g}"
    return f"≥ {low:g}" if high == INF else f"{low:g} … {high:g}"


TABLES: dict[str, Callable[..., str]] = {
    "ablation-gradients": ablation_gradients,
    "ablation-rewards": ablation_rewards,
    "best-rewards": best_rewards,
    "constants": constants,
    "costs": costs,
    "cuda-kernels": cuda_kernels,
    "dropout": dropout,
    "evaluations": evaluations,
    "geometry": geometry,
    "gpu": gpu,
    "gpu-line": gpu_line,
    "metrics": metrics,
    "published": published,
    "results": results,
    "returns": returns,
    "rewards": rewards,
    "tasks": tasks,
    "verification": verification,
}


def pages() -> list[Path]:
    """Pages that contain tables."""
    built = {"_build", "gallery"}
    own = (ROOT / "README.md", ROOT / "benchmarks/README.md")
    found = [*own, *(path for path in DOCS.rglob("*.md") if not built & set(path.parts))]
    return [path for path in sorted(found) if BLOCK.search(path.read_text())]


def refreshed(text: str) -> str:
    """A page with its tables written anew."""

    def write(block: re.Match[str]) -> str:
        name, *arguments = block[2].split()
        return f"{block[1]}{TABLES[name](*arguments)}\n{block[3]}"

    return BLOCK.sub(write, text)


if __name__ == "__main__":
    for page in pages():
        page.write_text(refreshed(page.read_text()))
