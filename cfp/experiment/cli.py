"""Functions of all command lines: error lines, exit codes, and how a program is called in its help."""

from __future__ import annotations

import inspect
import os
import re
import signal
import sys
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

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


def read_command(
    kind: Callable[..., Command],
    module: str,
    examples: Sequence[str],
    args: Sequence[str] | None,
    started: str | None = None,
    about: str | None = None,
    **options: Any,
) -> Command:
    """Read the command line of ``python -m MODULE`` into a dataclass; options of nested ones have no prefix.

    Args:
        kind: The dataclass; its docstring is the description, unless ``about`` is given.
        module: What was started.
        examples: Of its options, for the help.
        args: The command line; None: the program's own.
        started: How the program was started, if not as `program_name` says.
        about: Description for the help.
        options: Further ones of `tyro.cli`.
    """
    program = started or program_name(module, args)
    lines = "\n".join(f"  {program} {example}" for example in examples)
    about = f"{inspect.cleandoc(about or kind.__doc__ or '')}\n\nExamples:\n{lines}"
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    return tyro.cli(kind, prog=program, description=about, args=args, config=config, **options)
