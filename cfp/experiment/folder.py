"""The folder of a run: names of its files, its options, and a lock so that one process at a time trains in it."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

from filelock import FileLock, Timeout
from tyro.constructors import PrimitiveConstructorSpec

from cfp.config import RunConfig
from cfp.errors import CFPError, CheckpointError, ConfigError
from cfp.files import read_json
from cfp.policy import read_policy


def parse_folder(option: str, given: Any) -> Path:
    """The folder that an option names; a `ConfigError` if it cannot be the name of one."""
    if not isinstance(given, str | os.PathLike) or not str(given):
        # An empty word, from a shell's variable that is not set, would stand for the current folder.
        raise ConfigError(f"{option} must name a folder, got {given!r}")
    try:
        str(given).encode()
    except UnicodeEncodeError as error:
        raise ConfigError(f"{option} must be text in UTF-8, got {given!r}") from error
    return Path(given)


#: A folder to write into, as an option of a command line.
Folder = Annotated[
    Path,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="PATH",
        instance_from_str=lambda words: parse_folder("out", words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda folder: [str(folder)],
    ),
]


def holds_run(folder: Path) -> bool:
    """Whether a folder holds a run, finished or not."""
    marks = ("config.json", "checkpoint", "progress.csv", "evaluations.csv", "policy.safetensors")
    return any((folder / name).exists() for name in marks)


def holds_progress(folder: Path) -> bool:
    """Whether a run in a folder has got so far that there is something to lose: a checkpoint or a policy."""
    return (folder / "checkpoint" / "state.pt").exists() or policy_path(folder).exists()


def read_config(folder: Path, configure: Callable[[dict[str, Any]], RunConfig]) -> RunConfig:
    """Options of the run in a folder; `CheckpointError` where there is none or they cannot be read."""
    path = folder / "config.json"
    try:
        config = configure(read_json(path))
        config.check()
        return config
    except FileNotFoundError as error:
        raise CheckpointError(f"{folder}: there is no run (no config.json)") from error
    except ConfigError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error


def policy_path(folder: Path, stage: int | None = None) -> Path:
    """File of the policy in training (or trained last), or of a finished stage (from 1)."""
    return folder / ("policy.safetensors" if stage is None else f"stage{stage}.safetensors")


def start_path(folder: Path) -> Path:
    """The run's own copy of the policy that its first stage begins with, if the options name one."""
    return folder / "start.safetensors"


def policy_files(folder: Path, stages: int) -> dict[str, Path]:
    """Policies of a run so far by name: those of finished stages, then the one in training or trained last."""
    finished = {f"stage {stage}": policy_path(folder, stage) for stage in range(1, stages)}
    files = {name: path for name, path in finished.items() if path.exists()}
    newest = policy_path(folder)
    if newest.exists():
        files[f"stage {read_policy(newest)[1]['stage']}"] = newest
    return files


class FolderInUse(CFPError):
    """Another process holds the folder."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Hold the folder of a run, which is created if need be; the system releases it however the process ends."""
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"out: {folder} cannot be created as a folder ({error.strerror})") from error
    path = folder / ".lock"
    try:
        lock = FileLock(path).acquire(timeout=0)
    except Timeout:
        owner = path.read_text().strip() if path.exists() else ""
        raise FolderInUse(f"out: {folder} is in use by {owner or 'another process'}") from None
    except OSError as error:
        if error.filename is not None:  # it cannot be opened
            raise
        remedy = "some network file systems have no locks: name a folder on another one, such as a local disk"
        raise ConfigError(f"out: {folder} cannot be locked ({error.strerror}); {remedy}") from error
    try:
        with lock:
            path.write_text(f"process {os.getpid()} on {socket.gethostname()}\n")
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
    finally:
        if is_new:
            with suppress(OSError):  # something is in it
                folder.rmdir()
