"""Tables: CSV files that grow row by row and survive a crash, and rows rendered as CSV, Markdown and HTML."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
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

    def __init__(self, path: Path, last_step: int, numbers: Sequence[str] = ("step",)) -> None:
        self.path = path
        self.rows = [row for row in read_table(path, numbers) if float(row["step"]) <= last_step]
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


#: Values by the key of their column; None, or a missing key, is a value that does not exist.
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str  # in the rows
    title: str
    format: str = ""  # of numbers; columns without one hold text

    def text(self, row: Row) -> str:
        """The value of a row, for readers."""
        value = row.get(self.key)
        if value is None:
            return "–"
        return value if isinstance(value, str) else format(value, self.format)

    def html(self, row: Row | None = None) -> str:
        """The cell of a row, or without one the cell of the title.

        Its class tells apart texts, which are aligned to the left, and values that do not exist. Its data-title is
        shown on narrow screens, see ``STYLE`` in `cfp.evaluation.page`.
        """
        kind = "number" if self.format else "text"
        if row is None:
            return f'<th class="{kind}">{escape(self.title)}</th>'
        kind = "none" if row.get(self.key) is None else kind
        return f'<td class="{kind}" data-title="{escape(self.title)}">{escape(self.text(row))}</td>'


def columns(format: str = "", /, **titles: str) -> tuple[Column, ...]:
    """Several columns of one format, as ``key="title"``."""
    return tuple(Column(key, title, format) for key, title in titles.items())


@dataclass(frozen=True)
class Table:
    """Rows of plain values under a title and a description."""

    title: str
    description: str
    columns: Sequence[Column]
    rows: Sequence[Row]

    def to_markdown(self) -> str:
        """Heading, description and rows."""
        lines = [f"## {self.title}", "", self.description]
        if self.rows:
            titles = [column.title for column in self.columns]
            alignments = ["---:" if column.format else "---" for column in self.columns]
            rows = [[column.text(row).replace("|", "\\|") for column in self.columns] for row in self.rows]
            lines += ["", *(f"| {' | '.join(cells)} |" for cells in (titles, alignments, *rows))]
        return "\n".join(lines)

    def to_html(self) -> str:
        """Heading, description and rows."""
        head = f"<h2>{escape(self.title)}</h2>\n"
        head += f'<p class="note">{escape(self.description)}</p>\n' if self.description else ""
        if not self.rows:
            return head
        titles, *rows = ("".join(column.html(row) for column in self.columns) for row in (None, *self.rows))
        body = "\n".join(f"<tr>{row}</tr>" for row in rows)
        return f'{head}<div class="wide"><table><thead><tr>{titles}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
