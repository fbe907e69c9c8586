"""Errors that command lines report in one line, without a traceback."""


class CFPError(Exception):
    """Base class of all errors of this package."""


class ConfigError(CFPError, ValueError):
    """An option is wrong; the message names the option, what is allowed, and what was given."""


class CheckpointError(CFPError):
    """A file of a run is missing, damaged, or of another configuration."""


class NonFiniteError(CFPError, ArithmeticError):
    """A reward, an action or a loss is not finite; training stops before anything of it is stored."""
