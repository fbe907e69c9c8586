"""A table with declared columns, rendered as CSV, Markdown and HTML."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from cfp.tables import csv_text

#: Values by the key of their column; None, or a missing key, is a value that does not exist.
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    key: str  # in the rows, and the name in the CSV file
    title: str = ""  # an empty one restricts the column to the CSV file
    format: str = ""  # of numbers; columns without one hold text
    value: Callable[[Any], Any] | None = None  # from the subject of a row to its value, for `make_row`

    def text(self, row: Row) -> str:
        """The value of a row, for readers."""
        value = row.get(self.key)
        if value is None:
            return "–"
        return value if isinstance(value, str) else format(value, self.format)


def columns(format: str = "", /, **titles: str) -> tuple[Column, ...]:
    """Several columns of one format, as ``key="title"``."""
    return tuple(Column(key, title, format) for key, title in titles.items())


def make_row(columns: Sequence[Column], subject: Any) -> dict[str, Any]:
    """The values of all columns that have a ``value`` function."""
    return {column.key: column.value(subject) for column in columns if column.value is not None}


@dataclass(frozen=True)
class Table:
    """Rows of plain values; ``name`` is that of the CSV file, ``title`` and ``description`` are for readers."""

    name: str
    title: str
    description: str
    columns: Sequence[Column]
    rows: Sequence[Row]

    @property
    def visible(self) -> list[Column]:
        """Columns for readers."""
        return [column for column in self.columns if column.title]

    def to_csv(self) -> str:
        """All columns, with raw values."""
        return csv_text(self.rows, [column.key for column in self.columns])

    def to_markdown(self) -> str:
        """Heading, description and visible columns."""
        lines = [f"## {self.title}", "", self.description]
        if self.rows:
            titles = [column.title for column in self.visible]
            alignments = ["---:" if column.format else "---" for column in self.visible]
            rows = [[column.text(row).replace("|", "\\|") for column in self.visible] for row in self.rows]
            lines += ["", *(f"| {' | '.join(cells)} |" for cells in (titles, alignments, *rows))]
        return "\n".join(lines)

    def to_html(self) -> str:
        """Heading, description and visible columns."""
        head = f"<h2>{escape(self.title)}</h2>\n"
        head += f"<p>{escape(self.description)}</p>\n" if self.description else ""
        if not self.rows:
            return head
        rows = ["".join(_html_cell("th", column, column.title) for column in self.visible)]
        rows += ["".join(_html_cell("td", column, column.text(row)) for column in self.visible) for row in self.rows]
        return f"{head}<div class='wide'><table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table></div>"


def _html_cell(tag: str, column: Column, text: str) -> str:
    alignment = "" if column.format else ' class="text"'
    return f"<{tag}{alignment}>{escape(text)}</{tag}>"
