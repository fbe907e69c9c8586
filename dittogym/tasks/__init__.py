"""The registry of tasks: a name, and a function that returns its :class:`dittogym.spec.TaskSpec`."""

from __future__ import annotations

import importlib
import inspect
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from dittogym.bodies.drawings import BodyLike, with_body
from dittogym.bodies.json_values import from_values
from dittogym.bodies.positions import check_place
from dittogym.bodies.shapes import Shape
from dittogym.geometry import Obstacle
from dittogym.spec import BodySpec, TaskSpec
from dittogym.tasks.catch import catch
from dittogym.tasks.dig import dig
from dittogym.tasks.grow import grow
from dittogym.tasks.kick import kick
from dittogym.tasks.obstacle import obstacle
from dittogym.tasks.run import run
from dittogym.tasks.shapematch import shapematch
from dittogym.tasks.slot import slot
from torchmpm import checks

#: Functions by task name; their keyword arguments are the task's own options.
TASKS: dict[str, Callable[..., TaskSpec]] = {
    make.__name__: make for make in (shapematch, run, grow, kick, dig, obstacle, catch, slot)
}
#: Module of the function that a ``"MODULE:NAME"`` stood for at first; another one in its place is another task.
_defined_in: dict[str, str | None] = {}


def task_name(task: str) -> str:
    """The name alone of a task, or of something else, that may be given as ``"MODULE:NAME"``."""
    return task.rpartition(":")[2]


def headline(task: str) -> tuple[str, str]:
    """Title and goal of a task of the library, from its module's docstring; a custom task has its name and no goal."""
    name = task_name(task)
    if getattr(TASKS[name], "__module__", None) != f"{__name__}.{name}":
        return name, ""
    title, _, goal = (inspect.getdoc(inspect.getmodule(TASKS[name])) or "").partition(": ")
    return title, goal[:1].upper() + goal[1:]


def check_task(task: object) -> None:
    """Check that a value names a task; a module that it names is imported.

    Raises:
        ValueError: There is no such task.
    """
    reason = ""
    if isinstance(task, TaskSpec) or callable(task):
        reason = "; dittogym.register gives the function that makes a TaskSpec a name"
    elif isinstance(task, str):
        module, colon, name = task.rpartition(":")
        if colon and not module.isidentifier():  # options from elsewhere must not reach files below the current folder
            reason = " (the name of a module must be a word, without dots)"
        elif colon:
            try:
                importlib.import_module(module)
            except Exception as error:  # whatever the module does
                absent = getattr(error, "name", None) == module
                where = ", neither in the working directory nor on the Python path" if absent else ""
                last = traceback.extract_tb(error.__traceback__)[-1]
                line = "" if last.filename.startswith("<") else f", line {last.lineno} of {last.filename}"
                reason = f" (module {module!r}: {type(error).__name__}: {error}{where}{line})"
            else:
                reason = _registration_fault(task, module, name)
        if not reason and name in TASKS:
            return
    raise ValueError(f"task must be one of {', '.join(sorted(TASKS))} or MODULE:NAME{reason}, got {task!r}")


def _registration_fault(task: str, module: str, name: str) -> str:
    """What is wrong with a task whose module has been imported; empty if nothing is."""
    if name not in TASKS:
        return f" (module {module!r} does not register {name!r})"
    where = getattr(TASKS[name], "__module__", None)
    if _defined_in.setdefault(task, where) != where:
        return f" (module {where!r} has registered another {name!r} since; give it a name of its own)"
    return ""


def usual_horizon(task: str | TaskSpec) -> int:
    """Horizon of a task without its options, which is the limit that Gymnasium has for its ids."""
    return make_spec(task.name if isinstance(task, TaskSpec) and task.name in TASKS else task).horizon


def make_spec(
    task: str | TaskSpec, *, body: BodyLike | None = None, obstacles: Sequence[Obstacle] | None = None, **options: Any
) -> TaskSpec:
    """Return the specification of a task, with its options.

    Args:
        task: A name from :data:`dittogym.TASKS`; ``"MODULE:NAME"`` with a module, in the working directory or on the
            Python path, that registers the name when it is imported; or a specification.
        body: Another robot, see :func:`dittogym.bodies.drawings.with_body`; ``None`` for the task's own.
        obstacles: Obstacles in place of all of the task's own, floor and ceiling included, such as those that
            :func:`dittogym.geometry.solid` makes; ``None`` for the task's own.
        options: Options of this task: ``target`` and ``fit`` of SHAPE MATCH, ``variant`` of SLOT, or arguments of the
            function that a custom task is registered with.

    Raises:
        ValueError: There is no such task, an option is out of range, a body leaves the window or overlaps an obstacle,
            the robot reaches into the bounding box of the object or counts as torn from the start, or the goal lies
            outside a fixed window.
        TypeError: The task has no such option, or ``obstacles`` is not a sequence of
            :class:`dittogym.geometry.Obstacle`.

    Examples:
        >>> import dittogym
        >>> spec = dittogym.make_spec("shapematch", target="M")
        >>> spec.horizon, spec.coarse, spec.fine
        (30, 32, 64)
    """
    if isinstance(task, TaskSpec):
        name, make = task.name, lambda: task
    else:
        check_task(task)
        name = task_name(task)
        make = TASKS[name]
    signature = inspect.signature(make)
    try:
        signature.bind(**options)
    except TypeError as error:  # in Python's words, which programs that try out options look for
        known = ", ".join(("body", "obstacles", *signature.parameters))
        raise TypeError(f"task {name!r} {error}; its options are {known}, besides those of TorchEnv") from error
    spec = make(**options)
    if obstacles is not None:
        obstacles = [from_values(each) for each in obstacles] if isinstance(obstacles, list | tuple) else obstacles
        checks.instances("obstacles", obstacles, Obstacle)
        spec = replace(spec, obstacles=tuple(obstacles))
    if body is not None:
        body = from_values(body) if isinstance(body, Mapping) else body
        spec = with_body(spec, body)
    try:
        check_place(spec)
    except ValueError as error:
        if body is None or isinstance(body, Shape | BodySpec):
            raise
        raise ValueError(f"{error}; thicken the drawing or scale it down") from error
    return spec
