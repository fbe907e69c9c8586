"""Which runs a comparison consists of, with which options, and which of them are there."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from baselines.common.reference_policies import ReferenceConfig
from baselines.registry import ALGORITHMS, ALIASES, configure, sees
from cfp.config import EVALUATION_SEED, RunConfig, to_json
from cfp.errors import CheckpointError, ConfigError
from cfp.experiment.folder import holds_run, read_config
from cfp.files import parse_json, read_json
from cfp.from_dict import flatten
from cfp.sections import TASK_OPTIONS
from cfp.weights import is_of_another_task, is_same_task, read_policy
from dittogym.tasks import task_name

IRRELEVANT = ("device", "environment.backend", "report.video", "report.checkpoint_every", "report.log_every")
"""Options that change neither what a run learns nor which policy it keeps."""
FOR_ALL = {"task", "seed", "preset", "device"}
"""Options that the command line gives to all runs, or by which it tells them apart."""
SAME_TASK = ("substeps", "dtype", "parity", "resample", "target", "variant")
"""Options of the environment in which algorithms that are compared in a task must agree."""


@dataclass(frozen=True)
class Job:
    """A run of the comparison.

    Attributes:
        label: Name of the algorithm here: its own, or that of a variant in the plan file.
        config: Its options.
        folder: Its run folder.
    """

    label: str
    config: RunConfig
    folder: Path

    @property
    def name(self) -> str:
        """For messages."""
        return self.folder.name

    @property
    def sees(self) -> str:
        """What its policy looks at."""
        return str(getattr(self.config, "sees", sees(self.config.algo)))

    @property
    def untrained(self) -> bool:
        """Whether nothing is learned, so that the seed changes nothing: layouts and noise of judging are the same."""
        return isinstance(self.config, ReferenceConfig)

    @property
    def finished(self) -> bool:
        """Whether it has been trained to its end, here or by ``python -m baselines.train``."""
        noted = read_sessions(self.folder)["finished"]
        return noted in (True, self.config.ends()[-1]) or (self.folder / "results.json").exists()

    @property
    def state(self) -> str:
        """One of finished, failed, begun, missing."""
        if self.finished:
            return "finished"
        if (self.folder / "error.txt").exists():
            return "failed"
        return "begun" if holds_run(self.folder) else "missing"


def read_sessions(folder: Path) -> dict[str, Any]:
    """``sessions.json``: the step at which the run was finished or false, and each session that ended in order.

    Raises:
        CheckpointError: It is damaged.
    """
    path = folder / "sessions.json"
    if not path.exists():
        return {"finished": False, "sessions": []}
    return read_notes(path, finished=int, sessions=list)


def read_notes(path: Path, **kinds: type) -> dict[str, Any]:
    """A JSON object that a comparison has written into a run folder.

    Args:
        path: The file.
        kinds: What it holds by name, and of which type.

    Raises:
        CheckpointError: It cannot be read, or lacks something of that.
    """
    try:
        value = parse_json(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error
    for name, kind in kinds.items():
        if not isinstance(value, dict) or not isinstance(value.get(name), kind):
            raise CheckpointError(f"{path}: cannot be read (it holds no {name})")
    notes: dict[str, Any] = value
    return notes


@dataclass(frozen=True)
class Plan:
    """Options of runs beyond their presets, from a JSON file.

    Attributes:
        common: For every run.
        tasks: By task.
        algos: By algorithm. A name that is not one makes a variant: its options then say which ``algo``. Options under
            its ``tasks`` are for these tasks only.
    """

    common: dict[str, Any] = field(default_factory=dict)
    tasks: dict[str, dict[str, Any]] = field(default_factory=dict)
    algos: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path | None) -> Plan:
        """Read a file; without one nothing is changed.

        Raises:
            ConfigError: It cannot be read, or has other parts.
        """
        if path is None:
            return cls()
        try:
            values = read_json(path)
        except (OSError, ValueError) as error:
            raise ConfigError(f"plan: {path} cannot be read as JSON ({error})") from error
        if not set(values) <= {"common", "tasks", "algos"}:
            raise ConfigError(f"plan: {path} holds {', '.join(values)}, allowed an object with common, tasks, algos")
        _check_options("common", values.get("common", {}))
        for part in ("tasks", "algos"):
            for name, options in _group(part, values.get(part, {})).items():
                own = dict(_group(f"{part}.{name}", options))
                special = own.pop("tasks", {}) if part == "algos" else {}
                _check_options(f"{part}.{name}", own)
                for task, given in _group(f"{part}.{name}.tasks", special).items():
                    _check_options(f"{part}.{name}.tasks.{task}", given)
        return cls(**values)

    def options(self, label: str, task: str) -> dict[str, Any]:
        """What the file says about a run; the later in common, task, algorithm, algorithm in a task wins."""
        return _over(_over(self.common, self.tasks.get(task, {})), self.own(label, task))

    def own(self, label: str, task: str) -> dict[str, Any]:
        """What the file says about an algorithm alone."""
        own = dict(self.algos.get(label, {}))
        special = own.pop("tasks", {}).get(task, {})
        return _over(own, special)

    def unused(self, tasks: Sequence[str], labels: Sequence[str]) -> dict[str, set[str]]:
        """Names that are not in a comparison, by the part of the file that they are in."""
        parts = {"tasks": set(self.tasks) - set(tasks), "algos": set(self.algos) - set(labels)}
        for label in labels:
            parts[f"algos.{label}.tasks"] = set(self.algos.get(label, {}).get("tasks", {})) - set(tasks)
        return {part: names for part, names in parts.items() if names}


def _group(name: str, given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise ConfigError(f"plan: {name}: got {given!r}, allowed an object with named values")
    return given


def _check_options(name: str, given: Any) -> None:
    for taken in sorted(FOR_ALL & set(_group(name, given))):
        raise ConfigError(f"plan: {name}: got {taken}, allowed are options that the command line does not give")


def _over(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Options over options, group by group."""
    groups = [name for name in base if isinstance(base[name], dict) and isinstance(values.get(name), dict)]
    return {**base, **values} | {name: _over(base[name], values[name]) for name in groups}


def resolve(plan: Plan, label: str, task: str, preset: str, seed: int, steps: int | None, device: str) -> RunConfig:
    """Options of a run: preset, then plan file, then what the command line says for all.

    Raises:
        ConfigError: An option is wrong.
    """
    values = plan.options(label, task)
    general = values.pop("algo", label)  # of variants; an algorithm's own name means that algorithm
    algo = plan.own(label, task).get("algo", label if label in {*ALGORITHMS, *ALIASES} else general)
    start: dict[str, Any] = {"algo": algo, "task": task, "preset": preset}
    base = configure(start)
    if steps is not None and hasattr(base, "steps"):
        values.setdefault("steps", steps)
    report = {"video": False, **values.pop("report", {})}
    try:
        config = configure({**start, "seed": seed, "device": device, **values, "report": report}).with_derived(
            base, values
        )
        config.check()
        config.check_effect(base, flatten(plan.own(label, task)))  # what is for all may be idle in some
    except ConfigError as error:
        raise ConfigError(f"{label} on {task}: {error}") from error
    return config


def make_jobs(
    plan: Plan,
    tasks: Sequence[str],
    labels: Sequence[str],
    seeds: Sequence[int],
    runs: Path,
    *,
    preset: str = "quick",
    steps: int | None = None,
    device: str = "auto",
) -> list[Job]:
    """All runs of a comparison; those of one seed come first, so that a stop leaves something to compare.

    What learns nothing has one run, that of the first seed.

    Args:
        plan: Options beyond presets.
        tasks: Names.
        labels: Algorithms and variants.
        seeds: Of the runs.
        runs: Folder of the run folders.
        preset: Of all runs.
        steps: Environment steps, for algorithms that have this option and for which the plan does not say it.
        device: Of all runs.

    Raises:
        ConfigError: An option is wrong, or algorithms would not do the same task.
    """
    for name, given in (("tasks", tasks), ("algos", labels), ("seeds", seeds)):
        if not given or len(set(given)) < len(given):
            raise ConfigError(f"{name}: got {' '.join(map(str, given)) or 'none'}, allowed one or more, each once")
    for seed in seeds:
        if not 0 <= seed < EVALUATION_SEED - 1000:
            raise ConfigError(f"seeds: got {seed}, allowed 0 to {EVALUATION_SEED - 1001}: above are layouts that judge")
    for part, names in plan.unused(tasks, labels).items():
        print(f"plan: {part} {', '.join(sorted(names))} are not in this comparison")
    jobs = []
    for seed in seeds:
        for task in tasks:
            for label in labels:
                config = resolve(plan, label, task, preset, seed, steps, device)
                job = Job(label, config, runs / f"{label}-{task_name(task)}-{preset}-{seed}")
                if seed == seeds[0] or not job.untrained:
                    jobs.append(job)
    _check_same_task(jobs)
    return jobs


def _check_same_task(jobs: Sequence[Job]) -> None:
    first: dict[str, Job] = {}
    for job in jobs:
        other = first.setdefault(job.config.task, job)
        for name in SAME_TASK:
            mine, theirs = (getattr(each.config.environment, name) for each in (job, other))
            if mine != theirs and not _is_same(job.config.task, name, mine, theirs):
                raise ConfigError(
                    f"{name}: got {mine!r} for {job.label} and {theirs!r} for {other.label} on {job.config.task}, "
                    "allowed is the same for all, as the task would differ"
                )


def _is_same(task: str, option: str, mine: Any, theirs: Any) -> bool:
    """Whether one of two values is the task's default, and the other another word for it."""
    try:
        return option in TASK_OPTIONS and is_same_task(task, option, mine, theirs)
    except (ValueError, TypeError, OSError):  # the run itself says what is wrong with a value
        return False


def check_there(job: Job) -> None:
    """Compare what is in a job's folder with what it should be.

    Raises:
        ConfigError: There is a run with other options, of which the message names the first, or of a task of one's own
            whose file has changed since.
    """
    if not holds_run(job.folder):
        return
    try:
        there = read_config(job.folder, configure)
    except CheckpointError:
        if (job.folder / "config.json").exists():
            raise
        raise ConfigError(f"{job.folder}: there is something of a run, but no config.json") from None
    old, new = (flatten(json.loads(json.dumps(to_json(config)))) for config in (there, job.config))
    for name in {**old, **new}:
        if name not in IRRELEVANT and old.get(name) != new.get(name):
            raise ConfigError(
                f"{name}: the run in {job.folder} has {old.get(name)!r}, got {new.get(name)!r}; allowed is the same, "
                "or another --out"
            )
    newest = job.folder / "policy.safetensors"
    if newest.exists() and is_of_another_task(read_policy(newest)[1], job.config.task):
        raise ConfigError(
            f"task: the run in {job.folder} was trained when the file of {job.config.task!r} was another; allowed is "
            "the same, or another --out"
        )


def judged(config: RunConfig, tier: Any) -> RunConfig:
    """Options of the environment in which a run is judged: seed 0 for all, so that all get the same layouts.

    What that environment is depends on the tier and not on the run's own particles, so that it is the same for all.

    Args:
        config: Of the run.
        tier: Particles, see `cfp.config.EnvironmentConfig`.
    """
    return replace(config, seed=0, environment=config.environment.for_evaluation(tier))
