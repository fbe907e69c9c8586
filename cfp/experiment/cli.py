"""Functions of all command lines: error lines and exit codes, stop signals, and how a program is called in its help."""

from __future__ import annotations

import ctypes
import inspect
import io
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, TypeVar

import tyro

from cfp.errors import CFPError, NonFiniteError

Command = TypeVar("Command")
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD = -3, -1


def keep_memory() -> None:
    """Let glibc keep freed memory; fetching large tensors from the system anew makes an update a third slower."""
    if sys.platform != "linux":
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        # Before glibc 2.35 the threshold is at most 32 MiB. A threshold that was refused must not be followed by the
        # other setting, which would fix it at its small initial value.
        if any(library.mallopt(_M_MMAP_THRESHOLD, size) for size in (1 << 30, 1 << 25)):
            library.mallopt(_M_TRIM_THRESHOLD, (1 << 31) - 1)


@contextmanager
def printable() -> Iterator[None]:
    """Meanwhile the standard output shows what its encoding lacks as escapes, as Python's standard error always does.

    A program must not end because of a letter after hours of work.
    """
    output = sys.stdout
    if not isinstance(output, io.TextIOWrapper):
        yield
        return
    errors = output.errors
    output.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        output.reconfigure(errors=errors)


class Stopped(Exception):
    """A signal asked the program to stop, and all work done so far has been saved."""

    def __init__(self, number: int, hint: str = "") -> None:
        super().__init__(f"stopped by {signal.Signals(number).name}" + (f"; {hint}" if hint else ""))
        self.number = number


class StopSignals:
    """Lets training end its step after Ctrl-C or SIGTERM; the second one raises ``KeyboardInterrupt`` at once."""

    def __init__(self) -> None:
        self.number = 0
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._request)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.number:
            raise KeyboardInterrupt
        self.number = number
        print(
            "\nstopping after this step, with a checkpoint (press Ctrl-C again to stop at once, without one)",
            file=sys.stderr,
        )


@printable()
def run_command(command: Callable[[], int | None]) -> int:
    """Run a program; turn an expected error into one line on the standard error, and any outcome into an exit code.

    Returns:
        What ``command`` returned, None means 0; 2 for bad input (a `CFPError`); 1 for a failure (`NonFiniteError`,
        `OSError`, not enough memory); 128 plus the number of the signal that stopped the program.
    """
    keep_memory()
    if sys.stderr is None:  # closed by a shell; what is printed there would go to the standard output
        sys.stderr = open(os.devnull, "w")
    try:
        code = command() or 0
        print(end="", flush=True)  # while a reader that has gone is still noticed here; there may be no output
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
