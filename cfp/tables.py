"""CSV tables that grow row by row and survive a crash."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cfp.errors import CheckpointError
from cfp.files import names_file, write_text


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """A table as CSV."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


class CSVTable:
    """A CSV file that grows row by row, also over several sessions, and can take new columns on the way."""

    def __init__(self, path: Path, last_step: int | None = None, numbers: Sequence[str] = ("step",)) -> None:
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
        with names_file(self.path), open(self.path, "a", newline="") as file:
            csv.DictWriter(file, self.columns, lineterminator="\n").writerow(text)

    def _rewrite(self) -> None:
        write_text(self.path, csv_text(self.rows, self.columns))


def read_table(path: Path, numbers: Sequence[str] = ("step",)) -> list[dict[str, str]]:
    """Rows of a CSV file as text, none if it does not exist; a last line cut short by a crash is left out."""
    if not path.exists():
        return []
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:  # a spreadsheet may have saved it
            text = file.read()
        reader = csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1]))
        rows = [row for row in reader if row.get("step")]
    except (UnicodeDecodeError, csv.Error) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error
    if reader.fieldnames and "step" not in reader.fieldnames:
        raise CheckpointError(f"{path}: the first line must name a column step, got {', '.join(reader.fieldnames)}")
    for row in rows:
        for name in numbers:
            try:
                float(row.get(name) or "")
            except ValueError as error:
                raise CheckpointError(f"{path}: column {name} must hold numbers, got {row.get(name)!r}") from error
    return rows
