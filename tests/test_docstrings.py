"""Public names have docstrings that mention their arguments, and the reference shows them."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import docstring_parser
import pytest

import baselines
from cfp import registry

PACKAGES = ("torchmpm", "dittogym", "cfp", "baselines")
REFERENCE = Path(__file__).resolve().parents[1] / "docs/reference"


def ours(item: Any) -> bool:
    """Whether a class or function belongs to this project."""
    return str(item.__module__).partition(".")[0] in PACKAGES


def public(path: str, item: Any, owner: type | None = None) -> Iterator[tuple[str, Any, type | None]]:
    """A name, what it stands for and its class, and the same of the members of a module or class."""
    if isinstance(item, ModuleType):
        for key, member in vars(item).items():
            if not key.startswith("_") and getattr(member, "__module__", None) == item.__name__:
                yield from public(f"{path}.{key}", member)
    elif callable(item) or isinstance(item, property):
        yield path, item, owner
        for key, member in vars(item).items() if isinstance(item, type) else ():
            if not key.startswith("_") and isinstance(member, FunctionType | property):
                yield from public(f"{path}.{key}", member, item)


def texts(path: str, item: Any, owner: type | None) -> str:
    """Docstrings of a name, of what it overrides, and the sources of classes, whose fields have strings below them."""
    if isinstance(item, type):
        return "\n".join(inspect.getsource(base) for base in item.__mro__ if ours(base))
    key = path.rpartition(".")[2]
    found = [vars(base)[key] for base in owner.__mro__ if key in vars(base)] if owner else [item]
    return "\n".join(inspect.getdoc(each) or "" for each in found)


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_mention_the_arguments(package: str) -> None:
    module = importlib.import_module(package)
    for name in module.__all__:
        for path, item, owner in public(f"{package}.{name}", getattr(module, name)):
            text = texts(path, item, owner)
            assert text.strip() and (not isinstance(item, type) or item.__doc__), path
            if isinstance(item, FunctionType):
                for argument, about in inspect.signature(item).parameters.items():
                    # ``solver: Solver`` needs no words
                    plain = argument in ("self", "cls") or argument.title() in str(about.annotation)
                    assert plain or re.search(rf"\b{argument}\b", text), f"{path}: {argument}"


COMMANDS = (
    "cfp.evaluate",
    "cfp.robustness",
    "cfp.play.__main__",
    "baselines.leaderboard",
    "baselines.compare.__main__",
)


@pytest.mark.parametrize(
    "options",
    [
        *(importlib.import_module(name).Command for name in COMMANDS),
        *dict.fromkeys(type(registry.find(name).preset("shapematch", "quick")) for name in baselines.ALGORITHMS),
    ],
)
def test_options_are_described_in_one_line(options: type) -> None:
    for base in options.__mro__[:-1]:  # the help would break the text where its second line begins
        for about in docstring_parser.parse_from_object(base).params:
            assert "\n" not in (about.description or ""), f"{base.__name__}: {about.arg_name}"


@pytest.mark.parametrize("package", PACKAGES)
def test_completion_lists_every_public_name(package: str) -> None:
    module = importlib.import_module(package)
    assert {*module.__all__} <= {*dir(module)}  # also what is imported on first use


@pytest.mark.parametrize("package", PACKAGES)
def test_the_reference_shows_every_public_name(package: str) -> None:
    page = (REFERENCE / f"{package}.md").read_text()
    shown = set(re.findall(r"^\.\. (?:auto|py:)\w+:: (\S+)", page, flags=re.MULTILINE))
    assert {f"{package}.{name}" for name in importlib.import_module(package).__all__} - shown == set()
