"""Results of evaluations as JSON values and as text."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from cfp.config import RunConfig
from cfp.evaluation.returns import Result


def to_rows(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Results as JSON values."""
    return [
        {"policy": result.name, "action": f"{result.resolution}x{result.resolution}", **numbers(result)}
        for result in results
    ]


def numbers(result: Result) -> dict[str, Any]:
    """Numbers of a result as JSON values."""
    return {
        "episodes": len(result.returns),
        "mean": round(result.mean, 3),
        "std": round(result.std, 3),
        "interval": None if result.interval is None else round(result.interval, 3),
        "returns": [round(value, 3) for value in result.returns],
        "success": result.success,
    }


def format_table(config: RunConfig, results: Sequence[Result]) -> str:
    """Results as a plain text table: mean return, its 95 % confidence interval, and the spread of the episodes."""
    counts = {len(result.returns) for result in results}
    title = f"{config.task}, return over {' or '.join(map(str, sorted(counts)))} episodes"
    lines = [title, f"{'policy':<16}{'action':>8}{'mean':>10}{'± 95 %':>9}{'± std':>9}{'lowest':>10}{'highest':>10}"]
    for result in results:
        grid = f"{result.resolution}x{result.resolution}"
        interval = "–" if result.interval is None else f"{result.interval:.1f}"
        spread = f"{result.mean:>10.1f}{interval:>9}{result.std:>9.1f}"
        spread += f"{min(result.returns):>10.1f}{max(result.returns):>10.1f}"
        success = "" if result.success is None else f"   success {result.success:.0%}"
        lines.append(f"{result.name:<16}{grid:>8}{spread}{success}")
    return "\n".join(lines)
