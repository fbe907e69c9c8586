"""``python -m cfp.train``: train the coarse-to-fine policy, watch it, stop it, resume it."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tyro

from cfp.config import Config, merge
from cfp.errors import CFPError, ConfigError, NonFiniteError
from cfp.presets import preset
from cfp.process import Stopped, StopSignals, keep_memory
from cfp.runner import Runner, holds_run, read_config


@dataclass(frozen=True)
class Command:
    """Train the coarse-to-fine policy on a DittoGym task: all levels of the ladder, one after the other.

    Defaults come from the preset of the task; a --config file goes over them, the command line over both. Ctrl-C writes
    a checkpoint and stops; --resume goes on.
    """

    run: Config = field(default_factory=Config)
    out: Path | None = None
    """Folder of the run; runs/TASK-PRESET-SEED if not given."""
    resume: bool = False
    """Go on with the run in the folder; an empty or missing folder starts afresh."""
    config: Path | None = None
    """JSON file with options, in the form of a run's config.json; it may hold only some of them."""


@dataclass(frozen=True)
class _Choice:
    """What must be known before the defaults are: the same options, read first."""

    task: str | None = None
    preset: str | None = None
    seed: int | None = None
    out: Path | None = None
    resume: bool = False
    config: Path | None = None


def parse(arguments: Sequence[str]) -> Command:
    """Read a command line.

    Raises:
        ConfigError: An option is wrong.
        SystemExit: ``--help``, or an option that does not exist or cannot be read (exit code 2).
    """
    choice, _ = tyro.cli(_Choice, args=list(arguments), return_unknown_args=True, add_help=False, console_outputs=False)
    fresh, base = True, _base(choice)
    folder = choice.out or _default_folder(base if choice.seed is None else replace(base, seed=choice.seed))
    if choice.resume and (folder / "config.json").exists():
        fresh, base = False, read_config(folder)
    command: Command = tyro.cli(
        Command,
        prog="python -m cfp.train",
        args=list(arguments),
        default=Command(base),
        config=(tyro.conf.OmitArgPrefixes,),
    )
    run = command.run
    if fresh and run.steps != base.steps and run.handover == base.handover:
        share = run.steps / base.steps
        run = replace(run, handover=tuple(round(step * share) for step in base.handover))
    run.check()
    return replace(command, run=run, out=command.out or _default_folder(run))


def _base(choice: _Choice) -> Config:
    """Defaults: the preset, under the --config file if there is one."""
    values: dict[str, Any] = {}
    if choice.config is not None:
        try:
            values = json.loads(choice.config.read_text())
        except (OSError, ValueError) as error:
            raise ConfigError(f"config: {choice.config} cannot be read as JSON ({error})") from error
        if not isinstance(values, dict):
            raise ConfigError(f"config: {choice.config} holds {type(values).__name__}, allowed an object of options")
    task = choice.task or values.get("task", "shapematch")
    name = choice.preset or values.get("preset", "quick")
    merged: Config = merge(preset(task, name), values | {"task": task, "preset": name})
    return merged


def _default_folder(config: Config) -> Path:
    return Path("runs") / f"{config.task}-{config.preset}-{config.seed}"


def train(config: Config, folder: Path, resume: bool = False) -> None:
    """Do a run: train, evaluate, draw and film it.

    Args:
        config: Its options.
        folder: Its folder.
        resume: Go on from the folder's checkpoint if it has one.

    Raises:
        CFPError: See `Runner`; or training met a number that is not finite.
        Stopped: The user stopped it; the checkpoint is written.
    """
    with StopSignals() as signals:
        runner = Runner(config, folder, resume, signals)
        if config.environment.backend == "compile":
            print("compiling the physics; the first time on a machine this takes half a minute ...")
        if config.learning.compile:
            print("compiling the updates; the first time on a machine this takes minutes ...", flush=True)
        runner.train()
    runner.finish()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line entry; returns the exit code."""
    try:
        command = parse(sys.argv[1:] if arguments is None else arguments)
        assert command.out is not None
        folder = command.out
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"out: {folder} is a file, allowed is a folder")
        if command.resume and not holds_run(folder):
            print(f"{folder} holds no run yet: starting afresh")
        print(f"{command.run.task}, preset {command.run.preset}, seed {command.run.seed} -> {folder}")
        keep_memory()
        train(command.run, folder, command.resume)
    except Stopped as stopped:
        print(f"{stopped}; go on with: python -m cfp.train --resume --out {folder}")
        return 128 + stopped.number
    except CFPError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, NonFiniteError) else 2
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
