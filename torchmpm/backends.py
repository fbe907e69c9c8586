"""Names of the backends, and what they need."""

import functools
import logging

from torchmpm.native.library import find_compiler

BACKENDS = ("auto", "eager", "native")
_logger = logging.getLogger(__name__)


def compiler_found() -> bool:
    """Whether there is a C++ compiler: $CXX, g++ or clang++."""
    return find_compiler() is not None


@functools.cache
def warn_eager(what: str, reason: str) -> None:
    """Log once for each reason that ``what``, such as the physics, runs eagerly although that was not asked for."""
    _logger.warning("%s runs operator by operator, many times slower than it could: %s", what, reason)
