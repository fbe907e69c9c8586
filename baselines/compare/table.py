"""A table that can be written as CSV, Markdown and HTML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from cfp.tables import csv_text


@dataclass(frozen=True)
class Column:
    """A column.

    Attributes:
        key: Of the rows; its name in the CSV file.
        title: For readers.
        form: How values are formatted, for `format`; text stays as it is.
    """

    key: str
    title: str
    form: str = ""


@dataclass(frozen=True)
class Table:
    """Rows with plain values; None is a value that does not exist.

    Attributes:
        name: Of the CSV file.
        title: For readers.
        about: What it shows, in a sentence or two.
        columns: All of them; a title that is empty makes one for the CSV file only.
        rows: By key of a column.
    """

    name: str
    title: str
    about: str
    columns: tuple[Column, ...]
    rows: Sequence[Mapping[str, Any]]

    def to_csv(self) -> str:
        """All columns, with raw values."""
        return csv_text(self.rows, [column.key for column in self.columns])

    def to_markdown(self) -> str:
        """Heading, words and table."""
        lines = [f"## {self.title}", "", self.about, ""]
        if self.rows:
            rules = ("---" if column.form == "" else "---:" for column in self._shown())
            lines += [_line(column.title for column in self._shown()), _line(rules)]
            lines += [_line(cell.replace("|", "\\|") for cell in row) for row in self._cells()]
        return "\n".join(lines) + "\n"

    def to_html(self) -> str:
        """Heading, words and table."""
        head = "".join(f"<th{_side(column)}>{escape(column.title)}</th>" for column in self._shown())
        rows = [f"<tr>{head}</tr>"]
        for row in self._cells():
            cells = zip(self._shown(), row, strict=True)
            rows.append("<tr>" + "".join(f"<td{_side(column)}>{escape(cell)}</td>" for column, cell in cells) + "</tr>")
        table = f"<div class='wide'><table>{''.join(rows)}</table></div>" if self.rows else ""
        return f"<h2>{escape(self.title)}</h2>\n<p>{escape(self.about)}</p>\n{table}"

    def _shown(self) -> list[Column]:
        return [column for column in self.columns if column.title]

    def _cells(self) -> list[list[str]]:
        return [[_show(row.get(column.key), column.form) for column in self._shown()] for row in self.rows]


def _show(value: Any, form: str) -> str:
    if value is None:
        return "–"
    return value if isinstance(value, str) else format(value, form)


def _side(column: Column) -> str:
    return ' class="text"' if column.form == "" else ""


def _line(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |"
