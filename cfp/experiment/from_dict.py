"""JSON values over options in dataclasses, checked against the types of the fields."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import replace
from typing import Any, Literal

from cfp.errors import ConfigError

_KINDS: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "text",
    dict: "an object with named values",
    type(None): "null",
}


def merge(base: Any, values: Any, path: str = "") -> Any:
    """Put JSON values over a dataclass, recursively.

    Args:
        base: What the values leave out is taken from here.
        values: An object with named values.
        path: Where in the whole configuration this is, for the messages.

    Raises:
        ConfigError: An unknown name or a value of the wrong type.
    """
    if not isinstance(values, dict):
        raise ConfigError(f"{path or 'configuration'}: got {values!r}, allowed an object with named values")
    hints = typing.get_type_hints(type(base))
    kinds = {option.name: hints[option.name] for option in dataclasses.fields(base)}
    changes: dict[str, Any] = {}
    for name, value in values.items():
        where = f"{path}.{name}" if path else name
        if name not in kinds:
            raise ConfigError(f"{where}: no such option, allowed {', '.join(kinds)}")
        old = getattr(base, name)
        changes[name] = (
            merge(old, value, where) if dataclasses.is_dataclass(old) else _convert(value, kinds[name], where)
        )
    return replace(base, **changes)


def _convert(value: Any, kind: Any, where: str) -> Any:
    """Check a JSON value against a field's type and make lists tuples and integers floats where asked for."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value in arguments:
            return value
    elif origin is tuple:
        if isinstance(value, list | tuple):
            item = arguments[0]
            fixed = arguments[-1] is not Ellipsis
            if not fixed or len(value) == len(arguments):
                return tuple(_convert(each, item, where) for each in value)
    elif arguments:  # a union: the first kind that fits
        for choice in arguments:
            if choice is type(None) and value is None:
                return None
            try:
                return _convert(value, choice, where)
            except ConfigError:
                continue
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    raise ConfigError(f"{where}: got {value!r}, allowed {words(kind)}")


def words(kind: Any) -> str:
    """A field's type for people who write JSON."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return " or ".join(map(repr, arguments))
    if origin is tuple:
        count = "a list" if arguments[-1] is Ellipsis else f"a list of {len(arguments)}"
        return f"{count}, each {words(arguments[0])}"
    if arguments:
        return " or ".join(map(words, arguments))
    return _KINDS[kind]


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options under names with dots."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
