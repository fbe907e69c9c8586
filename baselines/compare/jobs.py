"""The runs of a comparison: which there are, with which options of the plan file, and which of them are finished."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from baselines.common.reference_policies import REFERENCE_POLICIES
from baselines.compare.final_evaluation import RECORD, Protocol, read_record
from baselines.registry import ALGORITHMS, ALIASES, configure, sees
from cfp.config import EVALUATION_SEED, RunConfig, to_json
from cfp.errors import ConfigError
from cfp.experiment.folder import holds_run, policy_path, read_config
from cfp.experiment.training import decisive
from cfp.files import read_json
from cfp.from_dict import differences, flatten, leaf_names
from cfp.policy import is_of_another_task, is_same_task, read_policy
from cfp.sections import TASK_OPTIONS
from dittogym.tasks import task_name

#: The layouts of training count on from the seed, and those of evaluations from ``EVALUATION_SEED``.
LARGEST_COMPARED_SEED = EVALUATION_SEED - 1001
#: Options that change neither what a run learns nor which policy it keeps.
IRRELEVANT_OPTIONS = ("device", "environment.backend", "report.video", "report.checkpoint_every", "report.log_every")
#: Options of the environment on which all algorithms of a task must agree.
TASK_DEFINING_OPTIONS = ("substeps", "dt", "dtype", "parity", "resample", "target", "variant")
#: Options of a run by name, in the form of its ``config.json``.
Options = dict[str, Any]

#: Options that the command line gives to all runs, or by which it distinguishes them.
COMMAND_LINE_OPTIONS = ("device", "preset", "seed", "task")


@dataclass(frozen=True)
class Plan:
    """Options of runs beyond their presets."""

    common: Options = field(default_factory=dict)
    tasks: dict[str, Options] = field(default_factory=dict)
    algos: dict[str, Options] = field(default_factory=dict)  # also by variant; ``tasks`` in them hold there only

    @classmethod
    def read(cls, path: Path | None) -> Plan:
        """Read a JSON file; no file is an empty plan."""
        if path is None:
            return cls()
        try:
            values = read_json(path)
        except (OSError, ValueError) as error:
            raise ConfigError(f"plan: {path} cannot be read as JSON ({error})") from error
        if not set(values) <= {"common", "tasks", "algos"}:
            raise ConfigError(f"plan: {path} must hold common, tasks and algos only, got {', '.join(values)}")
        _check_options("common", values.get("common", {}))
        for part in ("tasks", "algos"):
            _check_named_options(part, values.get(part, {}))
        algos = {ALIASES.get(name, name): options for name, options in values.get("algos", {}).items()}
        return cls(**{**values, "algos": algos})

    def options(self, label: str, task: str) -> Options:
        """Options of a run; of common, task, algorithm, and algorithm in a task the later ones win."""
        return _merge(_merge(self.common, self.tasks.get(task, {})), self.own_options(label, task))

    def own_options(self, label: str, task: str) -> Options:
        """Options of a run that the file gives for its algorithm alone."""
        own = dict(self.algos.get(label, {}))
        by_task = own.pop("tasks", {})
        return _merge(own, by_task.get(task, {}))

    def unused(self, tasks: Sequence[str], labels: Sequence[str]) -> dict[str, list[str]]:
        """Names in the file that are not part of a comparison, by the part of the file that holds them."""
        parts = {"tasks": set(self.tasks) - set(tasks), "algos": set(self.algos) - set(labels)}
        for label in labels:
            parts[f"algos.{label}.tasks"] = set(self.algos.get(label, {}).get("tasks", {})) - set(tasks)
        return {part: sorted(names) for part, names in parts.items() if names}


def _check_options(name: str, options: Any) -> None:
    """Check options of runs."""
    _check_object(name, options)
    for key in COMMAND_LINE_OPTIONS:
        if key in options:
            raise ConfigError(f"plan: {name} must not hold {key}, which the command line gives")


def _check_named_options(name: str, sections: Any) -> None:
    """Check options by the name of a task or an algorithm; those of an algorithm may hold some by task."""
    _check_object(name, sections)
    for key, options in sections.items():
        _check_options(f"{name}.{key}", options)
        if name == "algos" and "tasks" in options:
            _check_named_options(f"{name}.{key}.tasks", options["tasks"])


def _check_object(name: str, value: Any) -> None:
    if not isinstance(value, dict):
        raise ConfigError(f"plan: {name} must be a JSON object, got {value!r}")


def _merge(base: Options, values: Options) -> Options:
    """Options over options, group by group."""
    merged = {**base, **values}
    for name, group in base.items():
        if isinstance(group, dict) and isinstance(values.get(name), dict):
            merged[name] = _merge(group, values[name])
    return merged


@dataclass(frozen=True)
class Job:
    """A run of the comparison; ``label`` is the name of its algorithm, or of a variant in the plan file."""

    label: str
    config: RunConfig
    folder: Path
    protocol: Protocol

    @property
    def name(self) -> str:
        """Name of the run folder, for messages."""
        return self.folder.name

    @property
    def sees(self) -> str:
        """What the policy observes: image, state, simulator or nothing."""
        return str(getattr(self.config, "sees", sees(self.config.algo)))

    @property
    def untrained(self) -> bool:
        """Whether it evaluates a reference policy, which learns nothing and does not depend on the seed."""
        return self.config.algo in REFERENCE_POLICIES

    @property
    def trained(self) -> bool:
        """Whether training has ended, here or by ``python -m baselines.train``, if there is any."""
        if self.untrained:
            return (self.folder / RECORD).exists()
        finished = read_sessions(self.folder)["finished"] == self.config.ends()[-1]
        return finished or (self.folder / "results.json").exists()

    @property
    def error_file(self) -> Path:
        """Where the error of a run that has failed is written."""
        return self.folder / "error.txt"

    @property
    def error(self) -> str:
        """The error of a run that has failed, else nothing."""
        return self.error_file.read_text().strip() if self.error_file.exists() else ""

    @property
    def state(self) -> str:
        """One of finished, failed, begun, missing; the final evaluation is not looked at."""
        if self.trained:
            return "finished"
        if self.error:
            return "failed"
        return "begun" if holds_run(self.folder) else "missing"


def make_jobs(
    plan: Plan,
    tasks: Sequence[str],
    labels: Sequence[str],
    seeds: Sequence[int],
    folder: Path,
    protocol: Callable[[RunConfig], Protocol],
    *,
    preset: str = "quick",
    steps: int | None = None,
    device: str = "auto",
) -> list[Job]:
    """All runs of a comparison, by seed, so that one that is stopped early has something to compare."""
    for name, values in (("tasks", tasks), ("algos", labels), ("seeds", seeds)):
        if not values or len(set(values)) < len(values):
            given = " ".join(map(str, values)) or "none"
            raise ConfigError(f"{name} must be one or more different values, got {given}")
    for seed in seeds:
        if not 0 <= seed <= LARGEST_COMPARED_SEED:
            raise ConfigError(f"seeds must be between 0 and {LARGEST_COMPARED_SEED}, got {seed}")
    jobs = []
    for seed in seeds:
        for task in tasks:
            for label in labels:
                config = resolve(plan, label, task, preset, seed, steps, device)
                job = Job(label, config, folder / f"{label}-{task_name(task)}-{preset}-{seed}", protocol(config))
                if seed == seeds[0] or not job.untrained:  # reference policies have one run
                    jobs.append(job)
    _check_same_task(jobs)
    return jobs


def resolve(plan: Plan, label: str, task: str, preset: str, seed: int, steps: int | None, device: str) -> RunConfig:
    """Options of a run: from the preset, then the plan file, then the command line."""
    values, own = plan.options(label, task), plan.own_options(label, task)
    # An algo under common or tasks is that of variants; a label that names an algorithm keeps it, unless its own
    # section says otherwise.
    algo = values.pop("algo", label)
    if label in {*ALGORITHMS, *REFERENCE_POLICIES}:
        algo = own.get("algo", label)
    start = decisive(values) | {"algo": algo, "task": task, "preset": preset}
    try:
        base = configure(start)
        if steps is not None and hasattr(base, "steps"):
            values.setdefault("steps", steps)
        values["report"] = {"video": False, **values.get("report", {})}
        config = configure({**start, "seed": seed, "device": device, **values})
        config = config.with_derived(base, leaf_names(values))
        config.check()
        config.check_effect(base, flatten(own))  # options for all algorithms may have no effect on some of them
    except ConfigError as error:
        raise ConfigError(f"{label} on {task}: {error}") from error
    return config


def _check_same_task(jobs: Sequence[Job]) -> None:
    first: dict[str, Job] = {}
    for job in jobs:
        other = first.setdefault(job.config.task, job)
        for name in TASK_DEFINING_OPTIONS:
            mine, theirs = (getattr(each.config.environment, name) for each in (job, other))
            if mine != theirs and not _names_default(job.config.task, name, mine, theirs):
                raise ConfigError(
                    f"{name} must be the same for all algorithms on {job.config.task}, got {mine!r} for {job.label} "
                    f"and {theirs!r} for {other.label}"
                )


def _names_default(task: str, option: str, mine: Any, theirs: Any) -> bool:
    """Whether one of two values is None and the other names the task's default."""
    try:
        return option in TASK_OPTIONS and is_same_task(task, option, mine, theirs)
    except (ValueError, TypeError, OSError):  # a wrong value is reported by the run itself
        return False


def check_folder(job: Job) -> None:
    """Check that the run in a job's folder, if there is one, has the same options and task."""
    if not holds_run(job.folder):
        return
    if not (job.folder / "config.json").exists():
        raise ConfigError(f"out: {job.folder} holds files of a run but no config.json")
    there = read_config(job.folder, configure)
    for name, (old, new) in differences(to_json(there), to_json(job.config)).items():
        if name not in IRRELEVANT_OPTIONS:
            raise ConfigError(
                f"{name} must be {old!r} as in the run in {job.folder}, got {new!r}; or name another --out"
            )
    path = policy_path(job.folder)
    if path.exists() and is_of_another_task(read_policy(path)[1], job.config):
        raise ConfigError(
            f"task: the module or the target picture of {job.config.task!r} has changed since the run in {job.folder} "
            "was trained; name another --out"
        )


def read_sessions(folder: Path) -> dict[str, Any]:
    """``sessions.json``: the step at which training ended or false, and a record per session that ended in order."""
    path = folder / "sessions.json"
    return read_record(path, finished=int, sessions=list) if path.exists() else {"finished": False, "sessions": []}
