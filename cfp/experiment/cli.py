"""What all command lines share: error lines, exit codes, and how a program is called in its help."""

from __future__ import annotations

import inspect
import signal
import sys
from collections.abc import Callable, Sequence

from cfp.errors import CFPError, NonFiniteError
from cfp.experiment.process import Stopped, keep_memory


def run_command(command: Callable[[], int | None]) -> int:
    """Run a program; turn an expected error into one line on the standard error, and any outcome into an exit code.

    Returns:
        What ``command`` returned, None means 0; 2 for bad input (a `CFPError`); 1 for a failure (`NonFiniteError`,
        `OSError`, not enough memory); 128 plus the number of the signal that stopped the program.
    """
    keep_memory()
    try:
        return command() or 0
    except Stopped as stopped:
        print(stopped)
        return 128 + stopped.number
    except KeyboardInterrupt:
        print("stopped at once", file=sys.stderr)
        return 128 + signal.SIGINT
    except (CFPError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, NonFiniteError | OSError) else 2
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "allocate memory" not in str(error):  # how torch reports it
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
