"""Every public name documents its arguments, the shapes and units of tensors, and what it raises."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest
from docstring_parser import DocstringStyle, parse
from torch import Tensor

PACKAGES = ("torchmpm", "dittogym", "cfp", "baselines")
REFERENCE = Path(__file__).resolve().parents[1] / "docs/reference"
TENSORS = re.compile(r"^(?!Callable).*\b(Tensor|ndarray|NDArray|Points|Value|Float|Planes|Mat2|Sym2)\b")
#: A shape such as (B, N, 2), (B,) or (), or words for a lone number or a whole batch of anything.
SHAPE = re.compile(r"\((?:[A-Z]|\d|2·)[\w ]*(?:,[^()]*)?\)|\(\)|\bnumbers?\b|\bleading B\b|\bscalars?\b")
#: Units of quantities by the names that they have everywhere.
UNITS = {
    "actuation": "Pa",
    "corner": "m",
    "dt": "s",
    "gravity": "m/s^2",
    "lam": "Pa",
    "mass": "kg",
    "max_actuation": "Pa",
    "mu": "Pa",
    "origin": "m",
    "radius": "m",
    "split_limit": "m",
    "volume": "m^2",
    "yield_stress": "Pa",
    "young": "Pa",
}
#: The same where they are tensors; as numbers some of these names are weights.
TENSOR_UNITS = UNITS | {
    "C": "1/s",
    "com": "m",
    "energy": "J",
    "object_com": "m",
    "object_velocity": "m/s",
    "split": "m",
    "v": "m/s",
    "velocity": "m/s",
    "x": "m",
}


@dataclass(frozen=True)
class Name:
    """Something public.

    Attributes:
        path: Its dotted name.
        item: The class, function, method or property.
        owner: The class it belongs to, if any.
    """

    path: str
    item: Any
    owner: type | None = None

    @property
    def function(self) -> FunctionType | None:
        """What is called: the function itself, a property's getter, a class's own constructor."""
        item = inspect.unwrap(self.item) if callable(self.item) else self.item
        if isinstance(item, type):
            own = item.__init__ if not dataclasses.is_dataclass(item) else None
            return own if isinstance(own, FunctionType) and ours(own) else None
        if isinstance(item, property):
            return item.fget
        return getattr(item, "__func__", item) if callable(item) else None

    @cached_property
    def texts(self) -> list[str]:
        """Docstrings: its own, those of what it overrides or extends, and the constructor's."""
        if self.owner is not None:
            key = self.path.rpartition(".")[2]
            found = [inspect.getdoc(vars(base)[key]) for base in self.owner.__mro__ if key in vars(base)]
        elif isinstance(self.item, type):
            own = list(filter(ours, self.item.__mro__))
            found = [base.__doc__ and inspect.cleandoc(base.__doc__) for base in own]
            found += [inspect.getdoc(vars(base)["__init__"]) for base in own if "__init__" in vars(base)]
        else:
            found = [inspect.getdoc(self.item)]
        return [text for text in found if text]

    @property
    def text(self) -> str:
        """All of them."""
        return "\n\n".join(self.texts)

    @property
    def introduction(self) -> str:
        """What they say before the first section."""
        return "\n".join(parse(text, DocstringStyle.GOOGLE).description or "" for text in self.texts)

    @cached_property
    def described(self) -> dict[str, str]:
        """What the docstrings say about each argument or attribute."""
        said = attribute_docstrings(self.item) if isinstance(self.item, type) else {}
        for text in reversed(self.texts):
            for entry in parse(text, DocstringStyle.GOOGLE).params:
                said |= {name.strip(): entry.description or "" for name in entry.arg_name.split(",")}
        return said

    @property
    def result(self) -> str:
        """What they say about the result: its own section Returns, or else all."""
        returns = parse(self.texts[0], DocstringStyle.GOOGLE).returns
        return self.text if returns is None else returns.description or ""

    @property
    def annotated(self) -> dict[str, str]:
        """Annotations of the arguments and fields that a user may give."""
        fields = {}
        if isinstance(self.item, type):
            if dataclasses.is_dataclass(self.item):
                fields = {field.name: str(field.type) for field in dataclasses.fields(self.item) if field.init}
            elif issubclass(self.item, tuple):
                fields = {name: str(self.item.__annotations__[name]) for name in self.item._fields}
        if self.function is None or isinstance(self.item, property):
            return fields
        given = inspect.signature(self.function).parameters.values()
        return fields | {each.name: str(each.annotation) for each in given if each.name not in ("self", "cls")}


def ours(item: Any) -> bool:
    """Whether a class or function belongs to this project."""
    return str(item.__module__).partition(".")[0] in PACKAGES


def says_all(argument: str, kind: str) -> bool:
    """Whether name and type need no words: ``solver: Solver``, ``state: ParticleState``, ``report: ReportConfig``."""
    words = re.findall(r"[A-Z][a-z]+", kind.partition("[")[0])
    return argument in map(str.lower, words)


def lacks_unit(quantity: str, kind: str, text: str) -> bool:
    """Whether a text leaves out the unit that a quantity of this name and type has."""
    units = TENSOR_UNITS if TENSORS.search(kind) else UNITS if "float" in kind else {}
    return quantity in units and not re.search(rf"(?<![\w/]){re.escape(units[quantity])}(?![\w^])", text)


def attribute_docstrings(kind: type) -> dict[str, str]:
    """Strings that stand below the fields of a class and those it extends."""
    said: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not ours(base):
            continue
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        for field, text in zip(tree.body, tree.body[1:], strict=False):  # type: ignore[attr-defined]
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                said[ast.unparse(field.target)] = str(text.value.value)
    return said


def public(package: str) -> Iterator[Name]:
    """All names of ``__all__`` and, of modules and classes, their public members."""
    module = importlib.import_module(package)
    for name in module.__all__:
        item = getattr(module, name)
        yield from names(f"{package}.{name}", item)


def names(path: str, item: Any) -> Iterator[Name]:
    """A name and its members."""
    if isinstance(item, ModuleType):
        for key, member in vars(item).items():
            if not key.startswith("_") and getattr(member, "__module__", None) == item.__name__:
                yield from names(f"{path}.{key}", member)
    elif isinstance(item, type):
        yield Name(path, item)
        fields = vars(item).get("__annotations__", {})
        for key, member in vars(item).items():
            plain = getattr(member, "__func__", member)
            if not key.startswith("_") and isinstance(plain, (FunctionType, property)) and key not in fields:
                yield Name(f"{path}.{key}", member, item)
    elif callable(item):
        yield Name(path, item)


def raised(function: FunctionType | None, kind: Any) -> set[str]:
    """Names of the errors that a function, or a class when it is made, raises itself."""
    makers = [function, getattr(kind, "__post_init__", None)]
    found = set()
    for maker in makers:
        if not isinstance(maker, FunctionType) or not ours(maker):
            continue
        for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(maker)))):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                found.add(ast.unparse(node.exc.func).rpartition(".")[2])
    return {name for name in found if name.endswith("Error") and name != "NotImplementedError"}


def faults(name: Name) -> list[str]:
    """What the docstrings of a name leave out."""
    if not name.texts:
        return ["has no docstring"]
    found = []
    for argument, kind in name.annotated.items():
        about = name.described.get(argument)
        if about is None and says_all(argument, kind):
            continue
        if about is None and not re.search(rf"(?<![\w.]){re.escape(argument)}(?![\w(])", name.text):
            found.append(f"does not mention {argument}")
            continue
        if TENSORS.search(kind) and not SHAPE.search((about or "") + name.introduction):
            found.append(f"gives no shape of {argument}: {kind}")
        if lacks_unit(argument, kind, about or name.text):
            found.append(f"gives no unit of {argument}")
    function = name.function
    returns = "" if isinstance(name.item, type) or function is None else str(function.__annotations__.get("return"))
    if TENSORS.search(returns) and not SHAPE.search(name.result):
        found.append(f"gives no shape of its result, {returns}")
    if lacks_unit(name.path.rpartition(".")[2], returns, name.text):
        found.append("gives no unit of its result")
    for error in raised(function, name.item if isinstance(name.item, type) else None):
        if not any(
            entry.type_name == error for text in name.texts for entry in parse(text, DocstringStyle.GOOGLE).raises
        ):
            found.append(f"raises {error} and has no such line under Raises")
    return found


def vague(x: Tensor, count: int, mass: float) -> Tensor:
    """Move the particles ``x`` of some ``mass``."""
    raise ValueError("no")


def precise(x: Tensor, count: int, mass: float) -> Tensor:
    """Move particles.

    Args:
        x: (B, N, 2), m.
        count: How often.
        mass: Of a particle, kg.

    Returns:
        (B, N, 2).

    Raises:
        ValueError: Always.
    """
    raise ValueError("no")


def test_checker(monkeypatch: pytest.MonkeyPatch) -> None:
    for function in (vague, precise):
        monkeypatch.setattr(function, "__module__", "torchmpm")
    assert faults(Name("precise", precise)) == []
    assert faults(Name("vague", vague)) == [
        "gives no shape of x: Tensor",
        "gives no unit of x",
        "does not mention count",
        "gives no unit of mass",
        "gives no shape of its result, Tensor",
        "raises ValueError and has no such line under Raises",
    ]


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_documented(package: str) -> None:
    every = list(public(package))
    assert len(every) >= len(importlib.import_module(package).__all__) - 1
    assert {name.path: wrong for name in every if (wrong := faults(name))} == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_the_reference_shows_every_public_name(package: str) -> None:
    page = (REFERENCE / f"{package}.md").read_text()
    shown = set(re.findall(r"^\.\. (?:auto|py:)\w+:: (\S+)", page, flags=re.MULTILINE))
    assert {f"{package}.{name}" for name in importlib.import_module(package).__all__} - shown == set()
