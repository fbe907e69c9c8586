"""``torchmpm``: one command for all programs; it imports only the program that it starts."""

import os
import sys
from collections.abc import Sequence
from importlib import import_module

#: Module of each program, with a function ``main``, and what it does.
PROGRAMS = {
    "train": ("cfp.train", "train a policy on a task, by the coarse-to-fine method or another --algo"),
    "evaluate": ("cfp.evaluate", "returns of a trained policy, with films, replays and recorded trajectories"),
    "robustness": ("cfp.robustness", "return, success and robustness of policies"),
    "play": ("cfp.play.__main__", "play with a robot on a page in the browser"),
    "compare": ("baselines.compare.__main__", "train and evaluate several algorithms, and report about them"),
    "leaderboard": ("baselines.leaderboard", "evaluate and rank policies under a fixed protocol"),
}
EXAMPLES = """Examples:
  torchmpm train --task run --out runs/run
  torchmpm evaluate runs/run --video run.mp4
  torchmpm play run"""


def usage() -> str:
    """What ``torchmpm --help`` prints."""
    rows = "\n".join(f"  {name:<12} {about}" for name, (_, about) in PROGRAMS.items())
    return (
        f"usage: torchmpm PROGRAM [OPTIONS]\n\nSoft robots, simulated and differentiated in PyTorch.\n\n"
        f"Programs (torchmpm PROGRAM --help lists the options):\n{rows}\n\n{EXAMPLES}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    name, *words = (sys.argv[1:] if arguments is None else list(arguments)) or ["--help"]
    if name in ("-h", "--help"):
        print(usage())
        return 0
    if name == "--version":
        from importlib.metadata import version  # takes longer than all the rest

        print(f"torchmpm {version('torchmpm')}")
        return 0
    if name not in PROGRAMS:
        print(f"error: PROGRAM must be one of {', '.join(PROGRAMS)}, got {name!r}", file=sys.stderr)
        return 2
    sys.path.insert(0, os.getcwd())  # as `python -m` does, for tasks that are defined there
    sys.argv = [f"torchmpm {name}", *words]  # from which the programs read their options and their name
    import_module("baselines.registry")  # adds the algorithms of this package
    code: int = import_module(PROGRAMS[name][0]).main()
    return code


if __name__ == "__main__":
    sys.exit(main())
