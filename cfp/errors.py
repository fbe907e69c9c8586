"""Errors that command lines report in one line, without a traceback, and checks of option values that raise them."""

from __future__ import annotations

from typing import Any


class CFPError(Exception):
    """Base class of all errors of this package."""


class ConfigError(CFPError, ValueError):
    """An option is wrong; the message names the option, what is allowed, and what was given."""


class CheckpointError(CFPError):
    """A file of a run is missing, damaged, or of another configuration."""


class NonFiniteError(CFPError, ArithmeticError):
    """A reward, an action or a loss is not finite; training stops before anything of it is stored."""


def brief(value: Any) -> str:
    """A value in an error message, on one line of at most 200 characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 200 else f"{text[:197]}..."


def check_at_least(minimum: float, **values: float) -> None:
    """Check that each value, given by the name of its option, is at least ``minimum``; NaN is refused.

    So are integers of more than 64 bits, which fit neither tensors nor floats.
    """
    for name, value in values.items():
        if isinstance(value, int) and value >= 2**63:
            raise ConfigError(f"{name} must be below 2**63, got a number of {len(str(value))} digits")
        if not value >= minimum:
            raise ConfigError(f"{name} must be at least {minimum}, got {value}")


def check_positive(**values: float) -> None:
    """Check that each value, given by the name of its option, is positive; NaN is refused."""
    for name, value in values.items():
        if not value > 0:
            raise ConfigError(f"{name} must be positive, got {value}")


def check_fraction(**values: float) -> None:
    """Check that each value, given by the name of its option, lies in [0, 1]; NaN is refused."""
    for name, value in values.items():
        if not 0 <= value <= 1:
            raise ConfigError(f"{name} must be between 0 and 1, got {value}")


def check_below_one(**values: float) -> None:
    """Check that each value, given by the name of its option, lies in [0, 1); NaN is refused."""
    for name, value in values.items():
        if not 0 <= value < 1:
            raise ConfigError(f"{name} must be at least 0 and less than 1, got {value}")
