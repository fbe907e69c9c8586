"""A plan: which algorithms are trained on which tasks with which seeds, each as one command line of a training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.registry import ALGORITHMS
from cfp.config import EVALUATION_SEED, RunConfig, differences, to_words
from cfp.errors import ConfigError
from cfp.experiment.run import check_options
from cfp.files import read_json, write_json
from cfp.train import from_python
from dittogym.tasks import task_name

#: Options of a command line by name, with underscores.
Options = dict[str, Any]

#: The layouts of training count on from the seed, and those of evaluations during it from ``EVALUATION_SEED``.
LARGEST_SEED = EVALUATION_SEED - 1001
#: What the command line of the comparison gives to every run.
GIVEN = ("device", "preset", "seed", "task")
#: Options that define the task, which must be the same for all algorithms on it.
SAME_FOR_ALL = ("dt", "dtype", "resample", "substeps", "target", "variant")
#: Options that change neither what a run learns nor which policy it keeps.
WITHOUT_INFLUENCE = ("backend", "checkpoint_every", "device", "log_every", "video")
#: What a comparison keeps in the folder of a run: its options, its training time and its evaluation.
RECORD = "comparison.json"


def read_record(folder: Path) -> dict[str, Any]:
    """What `RECORD` in a folder holds; nothing before a comparison has begun the run there.

    Raises:
        ConfigError: It cannot be read.
    """
    path = folder / RECORD
    try:
        return read_json(path) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error


@dataclass(frozen=True)
class PlannedRun:
    """One element of a plan."""

    label: str  # the algorithm, or the variant of one that the plan names
    task: str
    seed: int
    options: Options  # of the training
    folder: Path

    @property
    def name(self) -> str:
        """Name of the folder, for messages."""
        return self.folder.name

    @property
    def reference(self) -> bool:
        """Whether this is a reference policy, which is evaluated only."""
        return self.options["algo"] in REFERENCE_POLICIES

    @property
    def words(self) -> list[str]:
        """The command line of the training: arguments of ``torchmpm train``."""
        return [*to_words(self.options), "--resume", "--out", str(self.folder)]

    @property
    def record(self) -> dict[str, Any]:
        """What `RECORD` holds, see `read_record`."""
        return read_record(self.folder)

    def update_record(self, **values: Any) -> None:
        """Put values into the record."""
        write_json(self.folder / RECORD, self.record | values)

    @property
    def error(self) -> str:
        """Why the last attempt failed; empty if it did not."""
        path = self.folder / "error.txt"
        return path.read_text(encoding="utf-8").strip() if path.exists() else ""

    @property
    def trained(self) -> bool:
        """Whether the training is finished, if there is one."""
        return self.reference or (self.folder / "results.json").exists()

    def check_folder(self) -> None:
        """Refuse a folder whose run has other options or was not made by a comparison."""
        there = self.record.get("options")
        if there is None:
            if (self.folder / "config.json").exists():
                raise ConfigError(f"out: {self.folder} holds a run that no comparison has begun; name another --out")
            return
        for name, (old, new) in differences(there, json.loads(json.dumps(self.options))).items():
            if name not in WITHOUT_INFLUENCE:
                raise ConfigError(
                    f"{name} must be {old!r} as in the run in {self.folder}, got {new!r}; or name another --out"
                )


def resolved(options: Options) -> RunConfig:
    """The whole configuration of a training; a `ConfigError` if it would not start."""
    config = from_python(options, None, False).run
    check_options(config)
    return config


def reference_config(options: Options) -> RunConfig:
    """The configuration in whose environment a reference policy acts, that of a single stage of learning."""
    kept = {name: value for name, value in options.items() if name in ("task", "device", *SAME_FOR_ALL)}
    preset = "paper" if options["preset"] == "paper" else "quick"
    return resolved({"algo": "coarse", "preset": preset, **kept})


def read_plan(path: Path | None) -> dict[str, Any]:
    """Read a plan file; it has options of trainings under ``common``, ``tasks`` and ``algos``."""
    plan: dict[str, Any] = {}
    if path is not None:
        try:
            plan = read_json(path)
        except (OSError, ValueError) as error:
            raise ConfigError(f"plan: {path} cannot be read as JSON ({error})") from error
    if not plan.keys() <= {"common", "tasks", "algos"}:
        raise ConfigError(f"plan: {path} must hold common, tasks and algos only, got {', '.join(plan)}")
    plan = {"common": {}, "tasks": {}, "algos": {}} | plan
    _check_section("common", plan["common"], GIVEN)
    for task, options in _check_section("tasks", plan["tasks"]).items():
        _check_section(f"tasks.{task}", options, GIVEN)
    for label, options in _check_section("algos", plan["algos"]).items():
        _check_section(f"algos.{label}", options, (*GIVEN, *SAME_FOR_ALL))
        for task, own in _check_section(f"algos.{label}.tasks", options.get("tasks", {})).items():
            _check_section(f"algos.{label}.tasks.{task}", own, (*GIVEN, *SAME_FOR_ALL))
    return plan


def _check_section(name: str, section: Any, refused: Sequence[str] = ()) -> dict[str, Any]:
    if not isinstance(section, dict):
        raise ConfigError(f"plan: {name} must be a JSON object, got {section!r}")
    for option in refused:
        if option in section:
            instead = "which the command line gives" if option in GIVEN else "which must be under common or tasks"
            raise ConfigError(f"plan: {name} must not hold {option}, {instead}")
    return section


def make_runs(
    plan: dict[str, Any],
    tasks: Sequence[str],
    labels: Sequence[str],
    seeds: Sequence[int],
    folder: Path,
    *,
    preset: str = "quick",
    steps: int | None = None,
    device: str = "auto",
) -> list[PlannedRun]:
    """All runs of a plan, by seed, so that a comparison that is stopped early has something to compare.

    Args:
        plan: What `read_plan` returns.
        tasks: Tasks.
        labels: Algorithms, reference policies, or variants that the plan names.
        seeds: Seeds; reference policies have one run, with the first.
        folder: Where the folders of the runs are.
        preset: Preset of all runs.
        steps: Environment steps of the algorithms that have this option, unless the plan gives them.
        device: cpu, cuda, or auto.

    Raises:
        ConfigError: A name, a seed or an option of a training is wrong.
    """
    for name, values in (("tasks", tasks), ("algos", labels), ("seeds", seeds)):
        if not values or len(set(values)) < len(values):
            raise ConfigError(
                f"{name} must be one or more different values, got {' '.join(map(str, values)) or 'none'}"
            )
    for label in labels:
        if Path(label).name != label:  # its folder would be elsewhere
            raise ConfigError(f"algos must be names without a path, got {label!r}")
    for seed in seeds:
        if not 0 <= seed <= LARGEST_SEED:
            raise ConfigError(f"seeds must be between 0 and {LARGEST_SEED}, got {seed}")
    parts = [("tasks", plan["tasks"], tasks), ("algos", plan["algos"], labels)]
    parts += [(f"algos.{label}.tasks", own.get("tasks", {}), tasks) for label, own in plan["algos"].items()]
    for part, names, given in parts:
        if unused := sorted(names.keys() - set(given)):
            print(f"plan: {part} {', '.join(unused)} are not in this comparison")
    found: dict[tuple[str, str], Options] = {}
    for task in tasks:
        for label in labels:
            options = _options(plan, label, task, {"preset": preset, "device": device})
            try:
                if options["algo"] in REFERENCE_POLICIES:
                    if useless := sorted(plan["algos"].get(label, {}).keys() - {"algo"}):
                        raise ConfigError(f"{useless[0]} must not be under algos.{label}, which is not trained")
                    reference_config(options)
                    options = {name: options[name] for name in ("algo", *GIVEN, *SAME_FOR_ALL) if name in options}
                elif hasattr(resolved(options), "steps") and steps is not None:
                    options.setdefault("steps", steps)
                    resolved(options)
            except ConfigError as error:
                raise ConfigError(f"{label} on {task}: {error}") from error
            found[task, label] = options
    runs = [
        PlannedRun(
            label,
            task,
            seed,
            options | {"seed": seed},
            folder / f"{task_name(label)}-{task_name(task)}-{preset}-{seed}",
        )
        for seed in seeds
        for (task, label), options in found.items()
        if seed == seeds[0] or options["algo"] not in REFERENCE_POLICIES
    ]
    places: dict[Path, PlannedRun] = {}
    for run in runs:  # as those of tasks of one name in two modules; the results of one would count for both
        if (other := places.setdefault(run.folder, run)) is not run:
            raise ConfigError(
                f"tasks and algos must not share folders, but {other.label} on {other.task} and {run.label} on "
                f"{run.task} are both named {run.name}"
            )
    return runs


def _options(plan: dict[str, Any], label: str, task: str, given: Options) -> Options:
    """Options of a run; of common, task, algorithm, and algorithm in a task the later ones win."""
    own = dict(plan["algos"].get(label, {}))
    own |= own.pop("tasks", {}).get(task, {})
    options = {"video": False, **plan["common"], **plan["tasks"].get(task, {}), **own}
    # An algo under common or tasks is that of variants; an algorithm keeps its own.
    known = label in {*ALGORITHMS, *REFERENCE_POLICIES} or ":" in label
    algo = own.get("algo", label if known else options.get("algo", label))
    return {"algo": algo, "task": task, **given, **{name: options[name] for name in options if name != "algo"}}
