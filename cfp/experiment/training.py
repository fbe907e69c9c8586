"""Training as a program: options from preset, file, and command line or Python."""

from __future__ import annotations

import difflib
import json
import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import tyro

from cfp.config import CoarseToFineConfig, RunConfig, to_json
from cfp.errors import ConfigError
from cfp.experiment.algorithm import Algorithm
from cfp.experiment.cli import program_name, read_options, run_command
from cfp.experiment.folder import Folder, holds_run, read_config
from cfp.experiment.process import Stopped, StopSignals
from cfp.experiment.run import TrainingRun, check_options
from cfp.experiment.run_lock import run_lock
from cfp.files import read_json
from cfp.from_dict import flatten, leaf_names, update_from_dict
from cfp.policy_protocols import Policy

#: Options that the help shows first.
BASIC = ("task", "target", "algo", "preset", "learner", "steps", "seed", "device", "out", "resume")


@dataclass(frozen=True)
class Program:
    """What the command lines of a package are made of."""

    package: str  # python -m PACKAGE.train
    about: str  # first words of the help
    examples: tuple[str, ...]  # of options, for the help
    configure: Callable[[dict[str, Any]], RunConfig]  # options from JSON values; the others come from the preset
    find: Callable[[RunConfig], type[Algorithm]]  # the algorithm that the options name
    load: Callable[[Path, str], Policy]  # loads a policy file onto a device


@dataclass(frozen=True)
class Command:
    """Default values come from the preset of the task, then from the --config file, then from the command line.

    This help shows those of one task; --task TASK --help shows those of another.

    Ctrl-C writes a checkpoint and stops the run; --resume continues it.
    """

    run: RunConfig
    out: Folder | None = None
    """Folder of the run; in runs/, named by algorithm, task, preset and seed, if not given."""
    resume: bool = False
    """Continue the run in the folder; if it holds none, start a new one, which needs --task."""
    config: Path | None = None
    """JSON file with options, in the form of a run's config.json; it may hold only some of them."""
    dry_run: bool = False
    """Only print the options as JSON; write nothing."""


@dataclass(frozen=True)
class _Choice:
    """Options that are read first, because they choose the preset, and so the default values of all others."""

    decisive: ClassVar[tuple[str, ...]] = ("algo", "task", "preset", "learner", "start_from", "refine")
    """Those that choose the defaults."""

    algo: str | None = None
    task: str | None = None
    preset: str | None = None
    learner: str | None = None
    start_from: str | None = None
    refine: bool = False
    out: Folder | None = None
    resume: bool = False
    config: Path | None = None


def parse(program: Program, arguments: Sequence[str], started: str | None = None) -> Command:
    """Read a command line; ``SystemExit`` after ``--help``, or for an option that does not exist or cannot be read."""
    prog = started or program_name(f"{program.package}.train", arguments)
    choice, _ = tyro.cli(_Choice, prog=prog, args=list(arguments), return_unknown_args=True, add_help=False)

    def read(defaults: RunConfig) -> Command:
        command: Command = read_options(
            Command(defaults),
            BASIC,
            prog=prog,
            about=program.about,
            examples=program.examples,
            args=list(arguments),
        )
        # the command line may spell the name of the algorithm in another way
        return command if choice.algo is None else replace(command, run=replace(command.run, algo=defaults.algo))

    named = {word[2:].partition("=")[0].replace("-", "_") for word in arguments if word.startswith("--")}
    return complete(program, _values(choice), choice.out, choice.resume, read, named)


def complete(
    program: Program,
    values: dict[str, Any],
    out: Path | None,
    resume: bool,
    read: Callable[[RunConfig], Command],
    named: Collection[str] = (),
) -> Command:
    """Complete the options of a run from its preset, or from the run that is resumed, and check them.

    Args:
        program: Whose options they are.
        values: Options as JSON values, in sections.
        out: Folder of the run, if given.
        resume: Whether to continue the run in that folder.
        read: Changes these options further.
        named: Options that it changes.
    """
    preset = program.configure(decisive(values))
    if "algo" in values:
        values = {**values, "algo": preset.algo}  # may be given in another spelling
    if resume:
        folder = out or Path("runs") / read(program.configure(values)).run.name
        if (folder / "config.json").exists():
            past = read_config(folder, program.configure)
            for name in ("algo", "learner"):
                own = getattr(past, name, None)
                if own is not None and (given := values.get(name, own)) != own:
                    raise ConfigError(f"{name} must be {own!r}, that of the run in {folder}, got {given!r}")
            command = read(update_from_dict(past, values))  # a value that differs from the run's is refused later
            command.run.check()
            return replace(command, out=folder)
        if "task" not in values and "task" not in named:
            raise ConfigError(f"out: {folder} holds no run to resume; name a --task to start one there")
    command = read(program.configure(values))
    run = command.run.with_derived(preset, leaf_names(values) | set(named))
    run.check()
    run.check_effect(preset)
    return replace(command, run=run, out=command.out or Path("runs") / run.name)


def from_python(program: Program, options: Mapping[str, Any], out: Path | None, resume: bool) -> Command:
    """Complete a run's ``options``, named as on the command line.

    Raises:
        ConfigError: There is no such option, or a value is wrong.
    """
    plain = {name: os.fspath(value) if isinstance(value, os.PathLike) else value for name, value in options.items()}
    places = {name.split(".")[-1]: name.split(".") for name in flatten(to_json(program.configure(decisive(plain))))}
    values: dict[str, Any] = {}
    for name, value in plain.items():
        if name not in places:
            close = difflib.get_close_matches(name, places, 1)
            instead = f"did you mean {close[0]}?" if close else f"python -m {program.package}.train --help lists them"
            raise ConfigError(f"{name} is not an option of this run; {instead}")
        *sections, key = places[name]
        section = values
        for each in sections:
            section = section.setdefault(each, {})
        section[key] = value
    return complete(program, values, out, resume, lambda config: Command(config, out, resume), plain.keys())


def decisive(values: Mapping[str, Any]) -> dict[str, Any]:
    """Of some options those that choose the defaults."""
    return {name: values[name] for name in _Choice.decisive if name in values}


def _values(choice: _Choice) -> dict[str, Any]:
    """Options that decide about the defaults, from the --config file and the command line."""
    values: dict[str, Any] = {}
    if choice.config is not None:
        try:
            values = read_json(choice.config)
        except (OSError, ValueError) as error:
            raise ConfigError(f"config: {choice.config} cannot be read as JSON ({error})") from error
    given = {name: value for name, value in decisive(vars(choice)).items() if value is not None and value is not False}
    return values | given


def main(program: Program, arguments: Sequence[str] | None = None, started: str | None = None) -> int:
    """Train as a command line says; returns the exit code."""
    words = sys.argv[1:] if arguments is None else arguments
    return run_command(lambda: _train(program, words, started or program_name(f"{program.package}.train", arguments)))


def _train(program: Program, arguments: Sequence[str], started: str) -> None:
    command = parse(program, arguments, started)
    train(program, command, f"resume with: {started} --resume --out {command.out}")


def train(program: Program, command: Command, hint: str) -> None:
    """Train, or resume, the run that `complete` has completed; ``hint`` tells how to resume it once stopped."""
    folder, config = command.out, command.run
    assert folder is not None
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"out must be a folder, got the file {folder}")
    if command.dry_run:
        check_options(config)
        print(json.dumps(to_json(config), indent=2))
        return
    if command.resume and not holds_run(folder):
        print(f"{folder} holds no run yet: starting a new one")
    with run_lock(folder):
        with StopSignals() as signals:
            run = TrainingRun(program.find(config), config, folder, command.resume, signals)
            learner = f", learner {config.learner}" if isinstance(config, CoarseToFineConfig) else ""
            print(f"{config.algo} on {config.task}{learner}, preset {config.preset}, seed {config.seed} -> {folder}")
            try:
                run.train()
            except Stopped as stopped:
                raise Stopped(stopped.number, hint) from None
        run.finish()
