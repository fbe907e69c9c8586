"""Functions of all command lines: error lines, exit codes, and how a program is called in its help."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import signal
import sys
import typing
from collections.abc import Callable, Sequence
from typing import Annotated, Any, TypeVar

import docstring_parser
import tyro

from cfp.errors import CFPError, NonFiniteError
from cfp.experiment.process import Stopped, keep_memory

Command = TypeVar("Command")


def run_command(command: Callable[[], int | None]) -> int:
    """Run a program; turn an expected error into one line on the standard error, and any outcome into an exit code.

    Returns:
        What ``command`` returned, None means 0; 2 for bad input (a `CFPError`); 1 for a failure (`NonFiniteError`,
        `OSError`, not enough memory); 128 plus the number of the signal that stopped the program.
    """
    keep_memory()
    try:
        code = command() or 0
        sys.stdout.flush()  # while a reader that has gone is still noticed here
        return code
    except Stopped as stopped:
        print(stopped)
        return 128 + stopped.number
    except KeyboardInterrupt:
        print("stopped at once", file=sys.stderr)
        return 128 + signal.SIGINT
    except BrokenPipeError:  # what reads the output, such as head, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the flush at the end of the program
        return 141  # 128 + SIGPIPE, which Windows does not name
    except (CFPError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, NonFiniteError | OSError) else 2
    except (MemoryError, RuntimeError) as error:
        # how torch reports it, on a CPU and on a GPU
        if isinstance(error, RuntimeError) and not re.search("allocate memory|out of memory", str(error)):
            raise
        advice = "reduce num_envs, episodes, particles or buffer_size"
        print(f"error: not enough memory: {advice} ({error})", file=sys.stderr)
        return 1


def program_name(module: str, arguments: Sequence[str] | None) -> str:
    """How the user started a program: ``torchmpm NAME``, ``python -m MODULE``, or ``python FILE`` for a script."""
    own = arguments is None and getattr(sys.modules["__main__"], "__spec__", None) is None
    if arguments is None and sys.argv[0].startswith("torchmpm "):  # set by the console command
        return sys.argv[0]
    return f"python {sys.argv[0]}" if own else f"python -m {module}"


def with_examples(about: str, program: str, *examples: str) -> str:
    """The description of a ``program`` for its help, followed by ``examples`` of its options."""
    lines = "\n".join(f"  {program} {example}" for example in examples)
    return f"{inspect.cleandoc(about)}\n\nExamples:\n{lines}"


def read_command(
    kind: Callable[..., Command], module: str, examples: Sequence[str], args: Sequence[str] | None, **options: Any
) -> Command:
    """Read the command line of ``python -m MODULE`` into a dataclass; ``options`` are further ones of `tyro.cli`."""
    program = program_name(module, args)
    about = with_examples(kind.__doc__ or "", program, *examples)
    return tyro.cli(kind, prog=program, description=about, args=args, **options)


def read_options(
    default: Any, basic: Sequence[str], *, prog: str, about: str, examples: Sequence[str], args: Sequence[str] | None
) -> Any:
    """Read a command line into a dataclass like ``default``; its help shows the options ``basic`` before the others."""
    about = with_examples(f"{about}\n\n{inspect.getdoc(type(default))}", prog, *examples)
    if {"-h", "--help"} & set(sys.argv[1:] if args is None else args):
        default = _basic_first(default, basic)  # the help ends the program, so that nothing is read into it
    options: Any = {"prog": prog, "description": about, "args": args, "config": (tyro.conf.OmitArgPrefixes,)}
    return tyro.cli(type(default), default=default, **options)


def _basic_first(options: Any, basic: Sequence[str]) -> Any:
    """The same options with those named ``basic`` in front and all others, in their groups, under ``advanced``."""
    first: list[Any] = []
    annotated: Any = Annotated  # type checkers know no types that are made at run time

    def remaining(group: Any) -> Any:
        hints, texts, others = typing.get_type_hints(type(group), include_extras=True), _descriptions(type(group)), []
        for field in dataclasses.fields(group):
            value = getattr(group, field.name)
            if dataclasses.is_dataclass(value):
                others.append(_option(field.name, type(nested := remaining(value)), nested))
            else:
                hint = annotated[hints[field.name], tyro.conf.arg(help=texts[field.name])]
                (first if field.name in basic else others).append(_option(field.name, hint, value))
        return dataclasses.make_dataclass(type(group).__name__, others, namespace={"__doc__": type(group).__doc__})()

    advanced = remaining(options)
    type(advanced).__doc__ = ""  # what the description says already
    first.sort(key=lambda option: basic.index(option[0]))
    return dataclasses.make_dataclass("Options", [*first, _option("advanced", type(advanced), advanced)])()


def _option(name: str, hint: Any, value: Any) -> tuple[str, Any, Any]:
    return name, hint, dataclasses.field(default_factory=lambda: value)


def _descriptions(kind: type) -> dict[str, str]:
    """The strings below the fields of a dataclass and of those that it extends."""
    bases = map(docstring_parser.parse_from_object, reversed(kind.__mro__[:-1]))
    return {each.arg_name: " ".join((each.description or "").split()) for base in bases for each in base.params}
