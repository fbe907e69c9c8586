"""The registry of tasks: a name, and a function that returns its :class:`dittogym.spec.TaskSpec`."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace

from dittogym.geometry import Obstacle
from dittogym.robots import BodyLike, with_body
from dittogym.spec import TaskSpec
from dittogym.tasks.catch import catch
from dittogym.tasks.dig import dig
from dittogym.tasks.grow import grow
from dittogym.tasks.kick import kick
from dittogym.tasks.obstacle import obstacle
from dittogym.tasks.run import run
from dittogym.tasks.shapematch import shapematch
from dittogym.tasks.slot import slot

#: Functions by task name; their keyword arguments are the task's own options.
TASKS: dict[str, Callable[..., TaskSpec]] = {
    make.__name__: make for make in (shapematch, run, grow, kick, dig, obstacle, catch, slot)
}


def make_spec(
    task: str | TaskSpec,
    *,
    body: BodyLike | None = None,
    obstacles: Sequence[Obstacle] | None = None,
    **options: object,
) -> TaskSpec:
    """The specification of a task.

    Args:
        task: A name from :data:`dittogym.TASKS`, or a specification.
        body: A robot of one's own, see :func:`dittogym.robots.with_body`.
        obstacles: Static geometry in place of the task's own, see :mod:`dittogym.geometry`.
        options: Options of that task, such as ``target`` of SHAPE MATCH.

    Raises:
        ValueError: No such task, or a body that does not fit into it.
        TypeError: The task has no such option, or the obstacles are something else.
    """
    if isinstance(task, TaskSpec):
        if options:
            raise TypeError(f"a TaskSpec takes no options but body and obstacles, got {sorted(options)}")
        spec = task
    else:
        if not isinstance(task, str) or task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(sorted(TASKS))}, got {task!r}")
        known = list(inspect.signature(TASKS[task]).parameters)
        for name in options:
            if name not in known:
                names = ", ".join(("body", "obstacles", *known))
                raise TypeError(f"task {task!r} has no option {name!r}; its options are: {names}")
        spec = TASKS[task](**options)
    if obstacles is not None:
        if not isinstance(obstacles, Sequence) or not all(isinstance(item, Obstacle) for item in obstacles):
            raise TypeError(f"obstacles must be a sequence of Obstacle, got {obstacles!r}")
        spec = replace(spec, obstacles=tuple(obstacles))
    return spec if body is None else with_body(spec, body)
