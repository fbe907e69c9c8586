"""``python -m baselines.replay RUN_FOLDER``: one episode of a policy of any algorithm, to watch in a browser."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import baselines.registry  # noqa: F401  (adds the algorithms)
from cfp.errors import ConfigError
from cfp.evaluate import Selection
from cfp.evaluation.video import check_files, record_policy
from cfp.experiment.cli import read_command, run_command
from cfp.files import check_output
from dittogym.render.film import available

EXAMPLES = ("runs/run", "--policy run --particles full --out run.html", "runs/run --out run.mp4")


@dataclass(frozen=True)
class Command(Selection):
    """Write one episode of a policy as a page (.html) that plays in any browser, or as a film."""

    out: Path = Path("replay.html")
    """The file: .html, .mp4, .gif or .webp, or .png for a row of pictures."""
    noise: Literal["default", "with", "without"] = "default"
    """Action noise: with, without, or default, as trained."""


def run(command: Command) -> None:
    """Play the episode and write the file."""
    check_files({"out": command.out}, {})
    if command.out.suffix == ".mp4" and not available():
        raise ConfigError("out needs the extra video for .mp4 (pip install 'torchmpm[video]'), or another suffix")
    config, policies = command.open()
    check_output("out", command.out)
    print(f"episode: {record_policy(config, list(policies.values())[-1], command.noise).save(command.out)}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    return run_command(lambda: run(read_command(Command, "baselines.replay", EXAMPLES, arguments)))


if __name__ == "__main__":
    sys.exit(main())
