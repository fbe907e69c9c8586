"""What a case of bad input is, where it works, and how it is run."""

import contextlib
import io
import shlex
import shutil
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from policy_files import write_stranger

from cfp import train
from cfp.policy import SHIPPED, read_policy

TINY = (
    "--learner sac --task shapematch --particles 100 --substeps 1 --num-envs 2 --resolutions 4 --steps 20 "
    "--random-steps 10 --batch-size 4 --buffer-size 60 --update-start 8 --gradient-steps 1 --eval-every 0 "
    "--eval-episodes 1 --checkpoint-every 10 --log-every 10 --no-video --device cpu --backend eager"
)


class Refused(Exception):
    """A command line ended with an exit code that is not 0; the text is all that it printed as an error."""


class Desk:
    """An empty folder for one case, and what can be laid out there before it."""

    def __init__(self, folder: Path, trained: Path) -> None:
        self.folder, self.trained, self.before = folder, trained, snapshot(folder)

    def file(self, name: str, content: bytes | str) -> None:
        """Write a file."""
        (self.folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        self.before = snapshot(self.folder)

    def link(self, name: str) -> None:
        """Make a symbolic link to itself."""
        (self.folder / name).symlink_to(name)
        self.before = snapshot(self.folder)

    def run(self, change: Callable[[Path], object] = lambda folder: None) -> None:
        """Copy the trained run and change the copy."""
        shutil.copytree(self.trained, self.folder / "run")
        change(self.folder / "run")
        self.before = snapshot(self.folder)

    def policy(
        self,
        changes: dict | None = None,
        weights: Callable[[dict], dict] = lambda tensors: tensors,
        name: str = "stranger",
    ) -> None:
        """Write the shipped policy of RUN with another description and other weights."""
        tensors, description = read_policy(SHIPPED / "run.safetensors")
        write_stranger(self.folder / f"{name}.safetensors", weights(tensors), {**description, **(changes or {})})
        self.before = snapshot(self.folder)


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@dataclass(frozen=True)
class Case:
    """A call with bad input, what its message must contain, and the beginning of the paths that it may add."""

    name: str
    call: Callable[[Desk], object]
    words: tuple[str, ...]
    error: type[Exception] = ValueError
    leaves: str = "nothing"

    def message(self, desk: Desk) -> str:
        """What the user is told, in one line and with the folder left out."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                self.call(desk)
            except self.error as error:
                return " ".join(str(error).split()).replace(str(desk.folder) + "/", "")
        raise AssertionError("was accepted")


def command(main: Callable[[list[str]], int], arguments: str, exit_code: int = 2) -> Callable[[Desk], None]:
    """A call of a command line; ``{folder}`` in the arguments stands for the desk's."""

    def call(desk: Desk) -> None:
        printed = io.StringIO()
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(printed):
            try:
                code = main([word.format(folder=desk.folder) for word in shlex.split(arguments)])
            except SystemExit as error:
                code = error.code
        if code:
            assert code == exit_code
            raise Refused(printed.getvalue())

    return call


def prepared(prepare: Callable[[Desk], object], call: Callable[[Desk], object]) -> Callable[[Desk], object]:
    """First one, then the other."""

    def both(desk: Desk) -> object:
        prepare(desk)
        return call(desk)

    return both


def make_trained(folder: Path) -> Path:
    """Train the run that desks copy."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert train.main([*TINY.split(), "--out", str(folder)]) == 0
    return folder


def table(rows, error=ValueError):
    """Cases of calls in Python: rows of a name, a call, and words of the error."""
    return [
        Case(name, lambda desk, call=call: call(), (words,) if isinstance(words, str) else tuple(words), error)
        for name, call, words in rows
    ]
