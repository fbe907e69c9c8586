"""Names of the backends, and the warning where one is many times slower than it could be."""

import functools
import logging

BACKENDS = ("auto", "eager", "native")
_logger = logging.getLogger(__name__)


@functools.cache
def warn_eager(what: str, reason: str) -> None:
    """Log once for each reason that ``what``, such as the physics, runs eagerly although that was not asked for."""
    _logger.warning("%s runs operator by operator, many times slower than it could: %s", what, reason)
