"""A page about a run that opens from disk: curve, final table, video, options; nothing is fetched from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

from cfp.config import RunConfig, to_json
from cfp.evaluation.evaluate import Result
from cfp.files import write_text

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
img, video { max-width: 100%; } video { width: 32rem; }
table { border-collapse: collapse; }
th, td { padding: 0.2rem 0.8rem; text-align: right; border-bottom: 1px solid #ccc; }
th:first-child, td:first-child { text-align: left; } pre { background: #f4f4f4; padding: 1rem; overflow-x: auto; }
"""
HEADER = ("policy", "action", "episodes", "mean return", "95 % interval", "std", "success")


def write_page(folder: Path, config: RunConfig, results: Sequence[Result]) -> Path:
    """Write ``index.html`` beside the files of a finished run that it shows; returns its path."""
    title = escape(f"{config.algo} on {config.task}, preset {config.preset}, seed {config.seed}")
    video = (folder / "video.mp4").exists()
    parts = [
        "<!doctype html>",
        f'<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style></head><body>',
        f"<h1>{title}</h1>",
        '<h2>Learning curve</h2><img src="curve.png" alt="Return over environment steps">',
        f"<h2>Final evaluation</h2>{_table(results)}",
        '<h2>Video</h2><video src="video.mp4" controls loop muted></video>' if video else "",
        _films(folder),
        f"<h2>Options</h2><pre>{escape(json.dumps(to_json(config), indent=2))}</pre>",
        "</body></html>",
    ]
    path = folder / "index.html"
    write_text(path, "\n".join(part for part in parts if part) + "\n")
    return path


def _films(folder: Path) -> str:
    """Links to the films made while training."""
    names = sorted(path.name for path in (folder / "videos").glob("*.mp4"))
    items = "".join(f'<li><a href="videos/{escape(name)}">{escape(name)}</a></li>' for name in names)
    return f"<h2>While training</h2><ul>{items}</ul>" if items else ""


def _table(results: Sequence[Result]) -> str:
    rows = ["<tr>" + "".join(f"<th>{escape(name)}</th>" for name in HEADER) + "</tr>"]
    for result in results:
        cells = (
            result.name,
            f"{result.resolution} × {result.resolution}",
            str(len(result.returns)),
            f"{result.mean:.1f}",
            "–" if result.interval is None else f"± {result.interval:.1f}",
            f"{result.std:.1f}",
            "–" if result.success is None else f"{result.success:.0%}",
        )
        rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    return "<table>" + "".join(rows) + "</table>"
