"""Draws the packages, their files and what they build on, from the files themselves."""

from __future__ import annotations

import ast
import sys
from dataclasses import dataclass
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: From the roof to the ground; `tests/test_architecture.py` holds that imports run downwards.
PACKAGES = ("baselines", "cfp", "dittogym", "torchmpm")


@dataclass(frozen=True)
class Floor:
    """A package.

    Attributes:
        name: Its name.
        what: First line of its docstring.
        rooms: First line of the docstring of each of its modules and subpackages, by name.
        own: Packages of the house that it imports.
        others: What else it imports that Python does not bring along.
    """

    name: str
    what: str
    rooms: dict[str, str]
    own: tuple[str, ...]
    others: tuple[str, ...]


def headline(file: Path) -> str:
    """First line of a module's docstring."""
    return (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]


def imported(file: Path) -> set[str]:
    """Packages that a file imports from outside its own folder."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


def survey(name: str) -> Floor:
    """Look through a package."""
    folder = ROOT / name
    rooms = {}
    for path in sorted(folder.iterdir()):
        file = path / "__init__.py" if path.is_dir() else path
        if file.suffix == ".py" and file.exists() and path.name != "__init__.py":
            rooms[path.stem if path.is_file() else f"{path.name}/"] = headline(file)
    names = {found for file in folder.rglob("*.py") for found in imported(file)} - {name}
    own = tuple(other for other in PACKAGES if other in names)
    others = tuple(sorted(names - set(PACKAGES) - sys.stdlib_module_names))
    return Floor(name, headline(folder / "__init__.py"), rooms, own, others)


def picture() -> str:
    """The house as HTML, styled by ``house.css``."""
    floors = []
    for floor in map(survey, PACKAGES):
        rooms = "".join(f'<li title="{escape(what)}">{escape(room)}</li>' for room, what in floor.rooms.items())
        builds = ", ".join((*floor.own, *floor.others))
        floors.append(
            f'<div class="floor"><p><strong>{floor.name}</strong> {escape(floor.what)}</p><ul>{rooms}</ul>'
            f"<p>imports {escape(builds)}</p></div>"
        )
    return f'<div class="house">{"".join(floors)}</div>'


def rooms(name: str) -> dict[str, str]:
    """What each file of a package is for, by name."""
    return {f"{name}/{room}": what for room, what in survey(name).rooms.items()}
