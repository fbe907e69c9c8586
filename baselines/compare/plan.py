"""The plan file: options of runs beyond their presets, by task and algorithm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cfp.errors import ConfigError
from cfp.files import read_json

Options = dict[str, Any]
"""Options of a run by name, in the form of its ``config.json``."""

COMMAND_LINE_OPTIONS = ("device", "preset", "seed", "task")
"""Options that the command line gives to all runs, or by which it distinguishes them."""


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
        for part, options in values.items():
            _check_options(part, options, named=part != "common")
        return cls(**values)

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


def _check_options(name: str, value: Any, named: bool) -> None:
    """Check options of runs, or if ``named`` such options by the name of a task or an algorithm."""
    if not isinstance(value, dict):
        raise ConfigError(f"plan: {name} must be a JSON object, got {value!r}")
    for key, item in value.items():
        if named or key == "tasks":
            _check_options(f"{name}.{key}", item, named=not named)
        elif key in COMMAND_LINE_OPTIONS:
            raise ConfigError(f"plan: {name} must not hold {key}, which the command line gives")


def _merge(base: Options, values: Options) -> Options:
    """Options over options, group by group."""
    merged = {**base, **values}
    for name, group in base.items():
        if isinstance(group, dict) and isinstance(values.get(name), dict):
            merged[name] = _merge(group, values[name])
    return merged
