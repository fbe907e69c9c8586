"""Writing files so that a crash at any moment leaves either the old file or the new one, whole."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from stable_baselines3.common.logger import KVWriter, TensorBoardOutputFormat, filter_excluded_keys
from torch.utils.tensorboard import SummaryWriter

from cfp.errors import CheckpointError

LARGEST_JSON = 2**20
"""Bytes of a JSON file that is read."""


def write_atomically(path: Path, write: Callable[[BinaryIO], Any]) -> None:
    """Write a file aside, flush it to disk, and move it into place.

    Args:
        path: Where it ends up; the folder is created.
        write: Called with the open binary file.

    Raises:
        OSError: The disk is full or the folder cannot be written; it names the file, and the old one, if any, is
            untouched.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(path.name + ".part")
    aside.unlink(missing_ok=True)  # where it is a link, its target must not be written to
    try:
        with _named(path), open(aside, "xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        aside.unlink(missing_ok=True)  # on a full disk every byte counts
        raise
    os.replace(aside, path)
    _sync_folder(path.parent)


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """A full disk is reported without a name: give it that of the file."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def copy_atomically(source: Path, target: Path) -> None:
    """Copy a file, as `write_atomically` writes one."""
    content = source.read_bytes()
    write_atomically(target, lambda file: file.write(content))


def _sync_folder(folder: Path) -> None:
    """Make a rename itself durable; some systems (Windows) cannot open a folder and need nothing here."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object from a file of moderate size.

    Raises:
        OSError: It is missing, or not a file that can be read.
        ValueError: It is not JSON in UTF-8, not an object, or larger than `LARGEST_JSON`.
    """
    if path.exists() and not path.is_file():
        raise OSError("it is not a file")  # a pipe or a device might never end
    with open(path, "rb") as file:
        content = file.read(LARGEST_JSON + 1)
    if len(content) > LARGEST_JSON:
        raise ValueError(f"it is larger than {LARGEST_JSON} bytes")
    value = parse_json(content.decode())
    if not isinstance(value, dict):
        raise ValueError(f"it holds {type(value).__name__}, allowed an object with named values")
    return value


def parse_json(text: str) -> Any:
    """Parse JSON of any depth.

    Raises:
        ValueError: It is not JSON.
    """
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def write_json(path: Path, value: Any) -> None:
    """Write JSON with an indent, atomically."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text, atomically."""
    write_atomically(path, lambda file: file.write(text.encode()))


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """A table as CSV.

    Args:
        rows: Values by column; other values are left out.
        columns: In their order.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


class Table:
    """A CSV file that grows row by row, also over several sessions, and can take new columns on the way.

    Args:
        path: The file; what it holds is kept.
        last_step: Rows whose ``step`` is beyond this are dropped: they belong to work that a resumed run repeats.
        numbers: Columns that hold a number in every row that is there.

    Raises:
        CheckpointError: The file is damaged.
    """

    def __init__(self, path: Path, last_step: int | None = None, numbers: Sequence[str] = ("step",)) -> None:
        """Read the file if it is there."""
        self.path = path
        self.rows = read_table(path, numbers)
        if last_step is not None:
            self.rows = [row for row in self.rows if float(row["step"]) <= last_step]
        self.columns = list(dict.fromkeys(key for row in self.rows for key in row))
        if self.columns or path.exists():
            self._rewrite()

    def add(self, row: dict[str, Any]) -> None:
        """Append one row; a key seen for the first time becomes a new column, empty in older rows."""
        text = {key: "" if value is None else str(value) for key, value in row.items()}
        self.rows.append(text)
        new = [key for key in text if key not in self.columns]
        if new:
            self.columns += new
            self._rewrite()
            return
        with _named(self.path), open(self.path, "a", newline="") as file:
            csv.DictWriter(file, self.columns, lineterminator="\n").writerow(text)

    def _rewrite(self) -> None:
        write_text(self.path, csv_text(self.rows, self.columns))


def read_table(path: Path, numbers: Sequence[str] = ("step",)) -> list[dict[str, str]]:
    """Rows of a CSV file as text, none if it does not exist; a last line cut short by a crash is left out.

    Args:
        path: The file.
        numbers: Columns that hold a number in every row.

    Raises:
        CheckpointError: It is no such table.
    """
    if not path.exists():
        return []
    try:
        with open(path, newline="") as file:
            text = file.read()
        complete = text[: text.rfind("\n") + 1]
        rows = [row for row in csv.DictReader(io.StringIO(complete)) if row.get("step")]
    except (UnicodeDecodeError, csv.Error) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error
    for row in rows:
        for name in numbers:
            _check_number(path, name, row.get(name))
    return rows


def _check_number(path: Path, column: str, text: str | None) -> None:
    try:
        float(text or "")
    except ValueError as error:
        raise CheckpointError(f"{path}: got {text!r} in column {column}, allowed is a number") from error


class ProgressTable(KVWriter):
    """A logger output that appends to ``progress.csv`` (stable-baselines3's own starts the file anew).

    Wall-clock values are left out, so that two runs with one seed write the same file.
    """

    def __init__(self, table: Table) -> None:
        """Write into a table."""
        self.table = table

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Append one row."""
        values = filter_excluded_keys(key_values, key_excluded, "csv")
        self.table.add({"step": step, **{key: values[key] for key in sorted(values)}})

    def close(self) -> None:
        """Nothing is held open."""


class EventFile(TensorBoardOutputFormat):
    """TensorBoard events that, on a resumed run, replace what was logged past the checkpoint.

    Args:
        folder: Where event files go.
        step: The step this session starts at.
    """

    def __init__(self, folder: Path, step: int) -> None:
        """Open a new event file."""
        self.writer = SummaryWriter(log_dir=str(folder), purge_step=step + 1 if step else None)
        self._is_closed = False
