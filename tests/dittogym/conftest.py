"""Collects the errors against the reference implementation and prints them as one table."""

from __future__ import annotations

import pytest

_ROWS = pytest.StashKey[list[tuple[str, str, float, float]]]()


@pytest.fixture
def parity_table(request: pytest.FixtureRequest) -> list[tuple[str, str, float, float]]:
    """Rows (file, quantity, error, bound) to be printed at the end of the run."""
    return request.config.stash.setdefault(_ROWS, [])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash.get(_ROWS, [])
    if not rows:
        return
    terminalreporter.section("largest differences from the reference implementation")
    for name, quantity, error, bound in rows:
        verdict = "" if error <= bound else "  EXCEEDED"
        terminalreporter.line(f"{name:36s} {quantity:26s} {error:9.2e}  bound {bound:7.1e}{verdict}")
