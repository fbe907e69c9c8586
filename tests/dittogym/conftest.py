"""Collects the errors against the reference implementation and prints them as one table."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

_ROWS = "parity"


@pytest.fixture
def parity_table(request: pytest.FixtureRequest) -> Iterator[list[tuple[str, str, float, float]]]:
    """Rows (file, quantity, error, bound) to be printed at the end of the run."""
    rows: list[tuple[str, str, float, float]] = []
    yield rows
    request.node.user_properties.append((_ROWS, rows))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    # Reports come from other processes too, where tests run in several; teardown's is the one after the fixture.
    reports = [report for group in terminalreporter.stats.values() for report in group]
    properties = [pair for report in reports for pair in getattr(report, "user_properties", ())]
    rows = [row for name, own in properties if name == _ROWS for row in own]
    if not rows:
        return
    terminalreporter.section("largest differences from the reference implementation")
    for name, quantity, error, bound in rows:
        verdict = "" if error <= bound else "  EXCEEDED"
        terminalreporter.line(f"{name:36s} {quantity:26s} {error:9.2e}  bound {bound:7.1e}{verdict}")
