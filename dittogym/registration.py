"""The Gymnasium ids ``dittogym/{task}-{coarse|fine}-v0``."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable

import gymnasium

from dittogym.env import Env
from dittogym.spec import TaskSpec
from dittogym.tasks import TASKS, make_spec
from dittogym.torch_env import TorchEnv
from dittogym.vector import BatchEnv

#: The tasks of the library, whose names stay theirs.
LIBRARY = dict(TASKS)
_SEVERAL = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
#: Arguments that environments keep to themselves.
TAKEN = {name for taker in (TorchEnv, Env, BatchEnv, make_spec) for name in inspect.signature(taker).parameters}


def register(task: str, make: Callable[..., TaskSpec]) -> None:
    """Register a task by name for :class:`dittogym.TorchEnv` and, in both resolutions, for Gymnasium.

    A name that is registered again, as in a notebook's cell that is run twice, stands for the later function.

    Args:
        task: Name of the task, one word; the ids are ``dittogym/{task}-coarse-v0`` and ``dittogym/{task}-fine-v0``.
        make: A function that returns the specification. Its arguments, which need defaults, become options of the
            environment. If one of them lengthens the horizon, pass ``max_episode_steps`` to ``gymnasium.make``, too.

    Raises:
        ValueError: ``task`` is the name of a task of the library, is not the name in the specification, or is not one
            word, or an argument of ``make`` has the name of an argument of the environments.
        TypeError: ``make`` is not a function without required arguments that returns a :class:`dittogym.TaskSpec`.

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
    if LIBRARY.get(task, make) is not make:
        raise ValueError(f"task must be a name that no task of the library has, got {task!r}")
    if not callable(make):
        raise TypeError(f"make must be a function that returns a TaskSpec, got {type(make).__name__}")
    own = {name for name, each in inspect.signature(make).parameters.items() if each.kind not in _SEVERAL}
    if taken := sorted(TAKEN & own):
        raise ValueError(f"make must have arguments of other names than the environments', got {', '.join(taken)}")
    spec = make()
    if not isinstance(spec, TaskSpec):
        raise TypeError(f"make must return a TaskSpec, got {type(spec).__name__}")
    if spec.name != task:
        raise ValueError(f"task must be the name in the specification, got {task!r} for a TaskSpec {spec.name!r}")
    TASKS[task] = make
    for resolution in ("coarse", "fine"):
        name = f"dittogym/{task}-{resolution}-v0"
        gymnasium.registry.pop(name, None)  # Gymnasium warns of ids that are replaced
        gymnasium.register(
            id=name,
            entry_point="dittogym.env:Env",
            vector_entry_point="dittogym.vector:BatchEnv",
            max_episode_steps=spec.horizon,
            kwargs={"task": address(task), "resolution": resolution},
        )


def address(task: str) -> str:
    """``MODULE:NAME`` of a task that another process finds by importing a module, else the name as it is."""
    module = sys.modules.get(getattr(TASKS.get(task), "__module__", ""))
    name = getattr(module, "__name__", "")
    importable = name.isidentifier() and name != "__main__" and getattr(module, "__file__", None) is not None
    return f"{name}:{task}" if importable else task
