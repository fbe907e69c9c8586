"""Draws the packages with their folders, modules and imports, and lists their modules, from the source files."""

from __future__ import annotations

import ast
import re
import sys
from dataclasses import dataclass
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: From the highest level to the lowest; `tests/test_architecture.py` checks that imports only go down.
PACKAGES = ("baselines", "cfp", "dittogym", "torchmpm")


@dataclass(frozen=True)
class Folder:
    """A folder of a package.

    Attributes:
        path: Path from the root of the repository, such as ``cfp/agent``.
        summary: First line of the docstring of its ``__init__.py``.
        modules: First line of the docstring of each module, by file name without suffix.
    """

    path: str
    summary: str
    modules: dict[str, str]


@dataclass(frozen=True)
class Package:
    """A package.

    Attributes:
        folders: Its folders, its own one first.
        internal: The other packages of the repository that it imports.
        external: All else that it imports, except the standard library.
    """

    folders: tuple[Folder, ...]
    internal: tuple[str, ...]
    external: tuple[str, ...]


def summary(file: Path) -> str:
    """First line of a module's docstring; references become code."""
    line = (ast.get_docstring(ast.parse(file.read_text())) or "").partition("\n")[0]
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", line)


def imported(file: Path) -> set[str]:
    """Top-level packages that a file imports by absolute names."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module.partition(".")[0])
    return names


def read_folder(folder: Path) -> Folder:
    """Read the docstrings of a folder's modules."""
    modules = {file.stem: summary(file) for file in sorted(folder.glob("*.py")) if file.name != "__init__.py"}
    return Folder(folder.relative_to(ROOT).as_posix(), summary(folder / "__init__.py"), modules)


def read_package(name: str) -> Package:
    """Read a package."""
    inits = sorted((ROOT / name).rglob("__init__.py"), key=lambda init: init.parent.parts)
    folders = tuple(read_folder(init.parent) for init in inits)
    names = {found for file in (ROOT / name).rglob("*.py") for found in imported(file)} - {name}
    internal = tuple(other for other in PACKAGES if other in names)
    external = tuple(sorted(names - set(PACKAGES) - sys.stdlib_module_names))
    return Package(folders, internal, external)


def diagram() -> str:
    """All packages as HTML, styled by ``site.css``."""
    boxes = []
    for name in PACKAGES:
        package = read_package(name)
        groups = "".join(map(group, package.folders))
        imports = escape(", ".join((*package.internal, *package.external)))
        boxes.append(f'<div class="package">{groups}<p>imports {imports}</p></div>')
    return f'<div class="packages">{"".join(boxes)}</div>'


def group(folder: Folder) -> str:
    """A folder and its modules as HTML."""
    modules = "".join(f'<li title="{plain(text)}">{escape(name)}</li>' for name, text in folder.modules.items())
    return f"<p><strong>{escape(folder.path)}/</strong> {plain(folder.summary)}</p><ul>{modules}</ul>"


def plain(text: str) -> str:
    """Escape a docstring for HTML, without its quotes of code."""
    return escape(text.replace("`", ""))


def module_table(name: str) -> dict[str, str]:
    """Summaries of the folders and modules of a package, by path."""
    table = {}
    for folder in read_package(name).folders:
        table[f"{folder.path}/"] = folder.summary
        table |= {f"{folder.path}/{module}.py": text for module, text in folder.modules.items()}
    return table
