"""The command line that trains: options from preset, file and command line."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import tyro

from cfp.config import RunConfig, to_json
from cfp.errors import ConfigError
from cfp.experiment.algorithm import Algorithm
from cfp.experiment.cli import program_name, run_command
from cfp.experiment.folder import Folder, holds_run, read_config
from cfp.experiment.process import Stopped, StopSignals
from cfp.experiment.run import Run, check_options
from cfp.experiment.run_lock import run_lock
from cfp.files import read_json
from cfp.from_dict import update_from_dict
from cfp.policy_protocols import Policy


@dataclass(frozen=True)
class Program:
    """What the command lines of a package are made of."""

    package: str  # python -m PACKAGE.train
    about: str  # first words of the help
    configure: Callable[[dict[str, Any]], RunConfig]  # options from JSON values; the others come from the preset
    find: Callable[[RunConfig], type[Algorithm]]  # the algorithm that the options name
    load: Callable[[Path, str], Policy]  # loads a policy file onto a device


@dataclass(frozen=True)
class Command:
    """Default values come from the preset of the task, then from the --config file, then from the command line.

    Ctrl-C writes a checkpoint and stops the run; --resume continues it.
    """

    run: RunConfig
    out: Folder | None = None
    """Folder of the run; in runs/, named by algorithm, task, preset and seed, if not given."""
    resume: bool = False
    """Continue the run in the folder; in an empty or missing folder, start a new run."""
    config: Path | None = None
    """JSON file with options, in the form of a run's config.json; it may hold only some of them."""
    dry_run: bool = False
    """Only print the options as JSON; write nothing."""


@dataclass(frozen=True)
class _Choice:
    """What must be known before the defaults are: the same options, read first."""

    decisive: ClassVar[tuple[str, ...]] = ("algo", "task", "preset", "learner", "start_from")
    """Those that choose the defaults."""

    algo: str | None = None
    task: str | None = None
    preset: str | None = None
    learner: str | None = None
    start_from: str | None = None
    out: Folder | None = None
    resume: bool = False
    config: Path | None = None


def parse(program: Program, arguments: Sequence[str], started: str | None = None) -> Command:
    """Read a command line; ``SystemExit`` after ``--help``, or for an option that does not exist or cannot be read."""
    choice, _ = tyro.cli(_Choice, args=list(arguments), return_unknown_args=True, add_help=False, console_outputs=False)
    values = _values(choice)
    preset = program.configure({name: values[name] for name in _Choice.decisive if name in values})

    def read(defaults: RunConfig) -> Command:
        command = tyro.cli(
            Command,
            prog=started or program_name(f"{program.package}.train", arguments),
            description=f"{program.about}\n\n{inspect.getdoc(Command)}",
            args=list(arguments),
            default=Command(defaults),
            config=(tyro.conf.OmitArgPrefixes,),
        )
        # the command line may spell the name of the algorithm in another way
        return command if choice.algo is None else replace(command, run=replace(command.run, algo=defaults.algo))

    if choice.resume:
        folder = choice.out or Path("runs") / read(program.configure(values)).run.name
        if (folder / "config.json").exists():
            past = read_config(folder, program.configure)
            # a value of the file that differs from the run's is refused later
            command = read(past if choice.config is None else update_from_dict(past, values))
            command.run.check()
            return replace(command, out=folder)
    command = read(program.configure(values))
    named = {word[2:].partition("=")[0].replace("-", "_") for word in arguments if word.startswith("--")}
    run = command.run.with_derived(preset, values.keys() | named)
    run.check()
    run.check_effect(preset)
    return replace(command, run=run, out=command.out or Path("runs") / run.name)


def _values(choice: _Choice) -> dict[str, Any]:
    """Options that decide about the defaults, from the --config file and the command line."""
    values: dict[str, Any] = {}
    if choice.config is not None:
        try:
            values = read_json(choice.config)
        except (OSError, ValueError) as error:
            raise ConfigError(f"config: {choice.config} cannot be read as JSON ({error})") from error
    names = _Choice.decisive
    return values | {name: value for name in names if (value := getattr(choice, name)) is not None}


def main(program: Program, arguments: Sequence[str] | None = None, started: str | None = None) -> int:
    """Train as a command line says; returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _train(program, words, started or program_name(f"{program.package}.train", arguments)))


def _train(program: Program, arguments: Sequence[str], started: str) -> None:
    command = parse(program, arguments, started)
    folder, config = command.out, command.run
    assert folder is not None
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"out must be a folder, got the file {folder}")
    if command.resume and not holds_run(folder):
        print(f"{folder} holds no run yet: starting a new one")
    if command.dry_run:
        check_options(config)
        print(json.dumps(to_json(config), indent=2))
        return
    print(f"{config.algo} on {config.task}, preset {config.preset}, seed {config.seed} -> {folder}")
    with run_lock(folder):
        with StopSignals() as signals:
            run = Run(program.find(config), config, folder, command.resume, signals)
            if config.environment.backend == "compile":
                print("compiling the physics; the first time on a machine this takes half a minute ...")
            try:
                run.train()
            except Stopped as stopped:
                raise Stopped(stopped.number, f"resume with: {started} --resume --out {folder}") from None
        run.finish()
