"""``python -m cfp.train``: train the coarse-to-fine policy, watch it, stop it, resume it.

Options come from the preset, a file, and the command line or Python.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import dittogym
from cfp import registry
from cfp.config import RunConfig, update_from_dict
from cfp.errors import ConfigError
from cfp.experiment.callbacks import OnEvaluation
from cfp.experiment.cli import Stopped, StopSignals, program_name, read_command, run_command
from cfp.experiment.folder import Folder, holds_run, parse_folder, read_config, run_lock
from cfp.experiment.run import TrainingRun, check_options
from cfp.files import read_json
from cfp.messages import say
from dittogym.registration import address

EXAMPLES = (
    "--task run",
    "--task shapematch --target M --seed 1 --out runs/M",
    "--task run --learner sac --dry-run",
    "--resume --out runs/M",
)
#: Options that choose the defaults of all others, and the folder.
DECISIVE = ("algo", "task", "preset", "seed", "device", "start_from", "refine")


@dataclass(frozen=True)
class Command:
    """Train a policy on a DittoGym task, one stage after the other.

    Default values come from the preset of algorithm, task and device, then from the --config file, then from the
    command line. This help shows those of one algorithm and task; --algo ALGO --task TASK --help shows those of others,
    and --device cuda --help those on a GPU that is named.

    Ctrl-C writes a checkpoint and stops the run; --resume continues it.
    """

    run: RunConfig
    learner: Literal["analytic", "sac"] | None = None
    """How the coarse-to-fine policy learns: short for --algo cfp-analytic and --algo cfp-sac."""
    out: Folder | None = None
    """Folder of the run; in runs/, named by algorithm, task, preset and seed, if not given."""
    resume: bool = False
    """Continue the run in the folder; if it holds none, start a new one, which needs --task."""
    config: Path | None = None
    """JSON file with options, in the form of a run's config.json; it may hold only some of them."""
    dry_run: bool = False
    """Only print the options as JSON; write nothing."""


def parse(words: Sequence[str], module: str = "cfp.train", started: str | None = None) -> Command:
    """Read a command line; ``SystemExit`` after ``--help``, or for an option that does not exist or cannot be read."""
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for name in ("algo", "task", "preset", "seed", "device", "start-from", "learner", "out", "config"):
        scan.add_argument(f"--{name}", f"--{name.replace('-', '_')}", nargs="?")  # what lacks a value is refused below
    for name in ("refine", "resume"):
        scan.add_argument(f"--{name}", action="store_true")
    first, _ = scan.parse_known_args(words)
    if first.algo is None and (algo := f"cfp-{first.learner}") in registry.ALGORITHMS:
        first.algo = algo
    try:
        first.seed = None if first.seed is None else int(first.seed)
    except ValueError:
        first.seed = None  # which is refused below
    values = _read_file(first.config)
    values |= {name: value for name in DECISIVE if _is_given(value := getattr(first, name))}
    defaults, out = _defaults(values, None if first.out is None else parse_folder("out", first.out), first.resume)
    algorithms = f"Algorithms: {', '.join(registry.ALGORITHMS)}, MODULE:CLASS.\nTasks: {', '.join(dittogym.TASKS)}."
    about = f"{inspect.cleandoc(Command.__doc__ or '')}\n\n{algorithms}"
    command = read_command(Command, module, EXAMPLES, words, started, about, default=Command(defaults, out=out))
    return _complete(command)


def _is_given(value: Any) -> bool:
    return value is not None and value is not False  # a seed of 0 equals False


def from_python(options: Mapping[str, Any], out: Path | None, resume: bool) -> Command:
    """Complete a run's ``options``, named as on the command line.

    Raises:
        ConfigError: There is no such option, or a value is wrong.
    """
    values = {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in options.items()}
    if isinstance(task := values.get("task"), str):
        values["task"] = address(task)  # so that programs that have not registered it can open the run
    defaults, out = _defaults(values, out, resume)
    return _complete(Command(defaults, out=out, resume=resume))


def _defaults(values: dict[str, Any], out: Path | None, resume: bool) -> tuple[RunConfig, Path | None]:
    """The options that ``values`` result in, those of the run that is resumed if there is one, and its folder."""
    if resume:
        decisive = {name: values[name] for name in DECISIVE if name in values}
        folder = out or Path("runs") / registry.configure(decisive).name
        if (folder / "config.json").exists():
            past = read_config(folder, registry.configure)
            if values.get("algo", past.algo) != past.algo:
                raise ConfigError(f"algo must be {past.algo!r}, that of the run in {folder}, got {values['algo']!r}")
            return update_from_dict(past, values), folder  # a value that differs from the run's is refused later
        if "task" not in values:
            raise ConfigError(f"out: {folder} holds no run to resume; name a --task to start one there")
    return registry.configure(values), out


def _complete(command: Command) -> Command:
    if command.learner is not None and (algo := f"cfp-{command.learner}") != command.run.algo:
        raise ConfigError(f"learner must not be given with another algo than {algo}, got {command.run.algo}")
    command.run.check()
    return replace(command, out=command.out or Path("runs") / command.run.name)


def _read_file(path: str | None) -> dict[str, Any]:
    if path is None:
        return {}
    try:
        return read_json(Path(path))
    except (OSError, ValueError) as error:
        raise ConfigError(f"config: {path} cannot be read as JSON ({error})") from error


def main(arguments: Sequence[str] | None = None, module: str = "cfp.train") -> int:
    """Train as a command line says, None the program's own; the help shows ``module``. Returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    started = program_name(module, arguments)

    def run() -> None:
        command = parse(words, module, started)
        train(command, f"resume with: {started} --resume --out {command.out}")

    return run_command(run)


def train(command: Command, hint: str, on_evaluation: OnEvaluation | None = None) -> None:
    """Train, or resume, the run that a completed command describes.

    Args:
        command: The command.
        hint: How to resume the run once it is stopped.
        on_evaluation: Called with each row of ``evaluations.csv``.
    """
    folder, config = command.out, command.run
    assert folder is not None
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"out must be a folder, got the file {folder}")
    if command.dry_run:
        check_options(replace(config, device="cpu"))  # the options of a GPU can be printed where there is none
        print(json.dumps(dataclasses.asdict(config), indent=2))
        return
    if command.resume and not holds_run(folder):
        say(f"{folder} holds no run yet: starting a new one")
    with run_lock(folder):
        with StopSignals() as signals:
            run = TrainingRun(registry.find(config.algo), config, folder, command.resume, signals, on_evaluation)
            say(f"{config.algo} on {config.task}, preset {config.preset}, seed {config.seed} -> {folder}")
            try:
                run.train()
            except Stopped as stopped:
                raise Stopped(stopped.number, hint) from None
        run.finish()


if __name__ == "__main__":
    sys.exit(main())
