"""Errors that name a user's mistake or a run's failure in one line."""


class CFPError(Exception):
    """Base of all errors that the command lines show without a traceback."""


class ConfigError(CFPError, ValueError):
    """An option is wrong: the message names it, what was given, and what is allowed."""


class CheckpointError(CFPError):
    """A file of a run is missing, damaged, or belongs to another configuration."""


class NonFiniteError(CFPError, ArithmeticError):
    """A reward, an action or a loss is not finite; training stops before anything of it is stored."""
