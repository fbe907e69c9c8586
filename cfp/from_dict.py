"""JSON values into dataclasses of options, checked against the types of the fields."""

from __future__ import annotations

import dataclasses
import typing
from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal, TypeVar

from cfp.errors import ConfigError
from cfp.validation import brief

Options = TypeVar("Options")

_TYPE_NAMES: dict[Any, str] = {
    int: "an integer",
    float: "a number",
    bool: "true or false",
    str: "a string",
    dict: "an object",
    type(None): "null",
}


def update_from_dict(base: Options, values: Any, path: str = "") -> Options:
    """Replace fields of a dataclass by JSON values, recursively; ``path`` is its dotted path, for error messages."""
    assert dataclasses.is_dataclass(base) and not isinstance(base, type)
    if not isinstance(values, dict):
        raise ConfigError(f"{path or 'configuration'} must be an object, got {values!r}")
    hints = typing.get_type_hints(type(base))
    types = {option.name: hints[option.name] for option in dataclasses.fields(base)}
    changes: dict[str, Any] = {}
    for name, value in values.items():
        where = f"{path}.{name}" if path else name
        if name not in types:
            sections = [section for section in types if dataclasses.is_dataclass(getattr(base, section))]
            found = [f"{section}.{name}" for section in sections if name in vars(getattr(base, section))]
            allowed = f"did you mean {found[0]}?" if found else f"options are {', '.join(types)}"
            raise ConfigError(f"{where} is not an option; {allowed}")
        old = getattr(base, name)
        nested = dataclasses.is_dataclass(old)
        changes[name] = update_from_dict(old, value, where) if nested else _convert(value, types[name], where)
    return replace(base, **changes)


def _convert(value: Any, kind: Any, where: str) -> Any:
    """Check a JSON value against a field's type; turns lists into tuples and integers into floats where required."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value in arguments:
            return value
    elif origin is tuple:
        variadic = arguments[-1] is Ellipsis
        if isinstance(value, list | tuple) and (variadic or len(value) == len(arguments)):
            return tuple(_convert(each, arguments[0], where) for each in value)
    elif arguments:  # a union: the first type that fits
        for choice in arguments:
            try:
                return _convert(value, choice, where)
            except ConfigError:
                continue
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(OverflowError):  # an integer beyond the largest float
            return float(value)
    elif isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        if kind is int and abs(value) >= 2**63:
            raise ConfigError(f"{where} must be between -2**63 and 2**63, got a number of {len(str(value))} digits")
        return value
    raise ConfigError(f"{where} must be {type_name(kind)}, got {brief(value)}")


def type_name(kind: Any) -> str:
    """A field's type in the words of JSON."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return " or ".join(map(repr, arguments))
    if origin is tuple:
        count = "a list" if arguments[-1] is Ellipsis else f"a list of {len(arguments)}"
        return f"{count}, each element {type_name(arguments[0])}"
    if arguments:
        return " or ".join(map(type_name, arguments))
    return _TYPE_NAMES[kind]


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options under dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def differences(first: dict[str, Any], second: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Options that differ, by dotted name: the value in each; None where there is none."""
    first, second = flatten(first), flatten(second)
    names = {**first, **second}
    return {name: (first.get(name), second.get(name)) for name in names if first.get(name) != second.get(name)}


def leaf_names(values: dict[str, Any]) -> set[str]:
    """Names of nested options without those of their sections."""
    return {name.rpartition(".")[2] for name in flatten(values)}
