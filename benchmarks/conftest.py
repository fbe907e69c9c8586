"""Collect milliseconds per substep and print them as one table at the end."""

import pytest
import torch

ROWS = pytest.StashKey[list[tuple[str, float, float, float]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[ROWS] = []


@pytest.fixture
def per_substep(request: pytest.FixtureRequest, benchmark):
    """Time ``run``, which advances ``particles`` particles by ``substeps`` substeps, and record the cost of one."""

    def measure(run, *, particles: int, substeps: int, rounds: int) -> None:
        # On CUDA the first call compiles, the second records a graph.
        benchmark.pedantic(run, rounds=rounds, warmup_rounds=2 if torch.cuda.is_available() else 1)
        if benchmark.stats is None:  # --benchmark-disable
            return
        least, median = (1e3 * benchmark.stats[key] / substeps for key in ("min", "median"))
        nanoseconds = 1e6 * least / particles
        benchmark.extra_info |= {
            "ms_per_substep_min": least,
            "ms_per_substep_median": median,
            "ns_per_particle_min": nanoseconds,
            "torch": torch.__version__,
            "threads": torch.get_num_threads(),
        }
        request.config.stash[ROWS].append((request.node.name.removeprefix("test_"), least, median, nanoseconds))

    return measure


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash[ROWS]
    if not rows:
        return
    terminalreporter.section("milliseconds per substep")
    terminalreporter.line(f"torch {torch.__version__}, {torch.get_num_threads()} threads")
    terminalreporter.line(f"{'':32}{'min':>10}{'median':>10}{'ns/particle (min)':>20}")
    for name, least, median, nanoseconds in rows:
        terminalreporter.line(f"{name:32}{least:10.3f}{median:10.3f}{nanoseconds:20.1f}")
