"""The Gymnasium ids ``dittogym/{task}-{coarse|fine}-v0``."""

from __future__ import annotations

import re
from collections.abc import Callable

import gymnasium

from dittogym.spec import TaskSpec
from dittogym.tasks import TASKS

ENTRY_POINT = "dittogym.env:Env"


def register(task: str, make: Callable[..., TaskSpec], *, namespace: str = "dittogym", version: int = 0) -> None:
    """Register a task by name for :class:`dittogym.TorchEnv` and, in both resolutions, for Gymnasium.

    Args:
        task: Its name; the ids are ``{namespace}/{task}-coarse-v{version}`` and ``{namespace}/{task}-fine-v{version}``.
        make: Returns the specification; its keyword arguments, which need defaults, become options of the environment.
            Where one of them lengthens the horizon, ``gymnasium.make`` needs ``max_episode_steps`` too.
        namespace: Of the ids.
        version: Increase it with every change of behaviour. If a function is defined again, as in a notebook, the ids
            of the old one are removed.

    Raises:
        ValueError: The name belongs to another function, differs from that in the specification or is not one word.
        TypeError: ``make`` is not a function, or does not return a :class:`dittogym.TaskSpec`.

    Examples:
        >>> import dataclasses, dittogym, gymnasium
        >>> def short_run(horizon=200):
        ...     return dataclasses.replace(dittogym.make_spec("run"), name="short_run", horizon=horizon)
        >>> dittogym.register("short_run", short_run)
        >>> gymnasium.spec("dittogym/short_run-coarse-v0").max_episode_steps
        200
    """
    if not isinstance(task, str) or re.fullmatch(r"\w+", task) is None:
        raise ValueError(f"task must be a name of letters, digits and underscores, got {task!r}")
    if not isinstance(namespace, str) or re.fullmatch(r"[\w:-]+", namespace) is None:
        raise ValueError(f"namespace must be a name of letters, digits, underscores and dashes, got {namespace!r}")
    if isinstance(make, TaskSpec):
        raise TypeError("make must be a function that returns a TaskSpec, got a TaskSpec")
    spec = make()
    if not isinstance(spec, TaskSpec):
        raise TypeError(f"make must return a TaskSpec, got {type(spec).__name__}")
    if _source(TASKS.get(task, make)) != _source(make):  # of local functions many have the same name
        raise ValueError(f"task must be a new name, got {task!r}, which is taken")
    if spec.name != task:
        raise ValueError(f"task must be the name in the specification, got {task!r} for a TaskSpec {spec.name!r}")
    if TASKS.get(task, make) is not make:
        for known in list(gymnasium.registry.values()):
            if known.entry_point == ENTRY_POINT and known.kwargs["task"] == task:
                del gymnasium.registry[known.id]
    for resolution in ("coarse", "fine"):
        name = f"{namespace}/{task}-{resolution}-v{version}"
        gymnasium.registry.pop(name, None)  # Gymnasium warns of ids that are replaced
        gymnasium.register(
            id=name,
            entry_point=ENTRY_POINT,
            vector_entry_point="dittogym.vector:BatchEnv",
            max_episode_steps=spec.horizon,
            kwargs={"task": task, "resolution": resolution},
        )
    TASKS[task] = make


def _source(make: Callable[..., TaskSpec]) -> object:
    """Where a function was defined, which stays the same if a notebook's cell defines it again."""
    name = getattr(make, "__qualname__", "<")
    return make if "<" in name else (make.__module__, name)
