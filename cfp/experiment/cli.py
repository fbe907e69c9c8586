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


def with_examples(about: str, program: str, *examples: str) -> str:
    """The description of a ``program`` for its help, followed by ``examples`` of its options."""
    lines = "\n".join(f"  {program} {example}" for example in examples)
    return f"{inspect.cleandoc(about)}\n\nExamples:\n{lines}"


def read_command(
    kind: Callable[..., Command],
    module: str,
    examples: Sequence[str],
    args: Sequence[str] | None,
    started: str | None = None,
    **options: Any,
) -> Command:
    """Read the command line of ``python -m MODULE`` into a dataclass; ``options`` are further ones of `tyro.cli`.

    Options of nested dataclasses have no prefix.
    """
    program = started or program_name(module, args)
    about = with_examples(kind.__doc__ or "", program, *examples)
    config = (tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes)
    return tyro.cli(kind, prog=program, description=about, args=args, config=config, **options)
