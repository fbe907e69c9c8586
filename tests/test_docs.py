"""Tables and pictures of the documents show the committed results, the present code and the present policies."""

import csv
import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
sys.path.append(str(DOCS))

import drawings  # noqa: E402
import media  # noqa: E402
import tables  # noqa: E402

from torchmpm.native.cuda.compiler import digest_of_sources  # noqa: E402


@pytest.mark.parametrize("page", tables.pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_tables_are_current(page):
    assert page.read_text() == tables.refreshed(page.read_text()), "python docs/tables.py writes the tables anew"


def test_table_of_evaluations_is_made_of_the_rows_that_exist(tmp_path, monkeypatch):
    def row(policy, case, mean, particles="lite", noise="with", success="0.5"):
        about = {"protocol": "v2", "task": "run", "policy": policy, "case": case, "particles": particles}
        measured = {"noise": noise, "mean": mean, "interval": "100.4", "success": success, "sha256": "a"}
        return about | measured | ({"sha256": "", "noise": "without"} if policy == "zero" else {})

    rows = [
        row("zero", "undisturbed", "2000.0"),
        row("mine", "undisturbed", "12000.0"),
        row("mine", "latency", "7000.0"),
        *(row("mine", f"mu x {factor}", mean) for factor, mean in ((0.8, "11000.0"), (1.2, "10000.0"))),
        row("mine", "own start", "9000.0", "full", success="1.0"),
        row("mine", "undisturbed", "3000.0", noise="without"),
    ]
    monkeypatch.setattr(tables, "DOCS", tmp_path)
    with (tmp_path / "evaluations.csv").open("w") as file:
        writer = csv.DictWriter(file, tables.COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    head, _, *lines = tables.evaluations().splitlines()
    noisy, quiet = (dict(zip(head.split(" | "), line.split(" | "), strict=True)) for line in lines)
    assert noisy["policy"] == "`mine`" and quiet["policy"] == "`mine`, mean action"
    assert noisy["random actions"] == noisy["full"] == ""
    assert (noisy["return, lite"], quiet["return, lite"]) == ("12,000 ± 100", "3,000 ± 100")
    assert noisy["success, lite / full"] == "50% / –"
    assert (noisy["latency"], noisy["matter"], noisy["noise"]) == ("0.50 (0.58)", "0.80 (0.83)", "")


def test_options_of_an_algorithm_have_returns_of_their_own(monkeypatch):
    about = {"task": "run", "particles": "full", "observes": "nothing", "mean": "1", "episodes": "3"}
    rows = [
        about | {"algorithm": "`gradient`"},
        about | {"algorithm": "`gradient --learning-rate 0.1 --polish 90`", "mean": "2", "episodes": "5"},
    ]
    monkeypatch.setattr(tables, "read", lambda name: rows if name == "returns.csv" else [])
    _, _, *lines = tables.returns().splitlines()
    assert [line.split(" | ")[1:4:2] for line in lines] == [
        ["`gradient`", "1"],
        ["`gradient --learning-rate 0.1 --polish 90`", "2"],
    ]


def test_episodes_that_chose_a_policy_are_not_said_to_be_above_the_paper():
    row = {"mean": "9000.0", "interval": "100.0"}
    assert tables.compared(row | {"task": "run"}, 8650) == "**9,000 ± 100**"
    assert tables.compared(row | {"task": "obstacle"}, 8650) == "9,000 ± 100"


@pytest.mark.parametrize(
    "name", ["returns.svg", "rewards.svg", *(f"tasks/{task}.png" for task in drawings.dittogym.TASKS)]
)
def test_pictures_are_current(name):
    assert drawings.source(name).encode() in (DOCS / "images" / name).read_bytes(), "python docs/drawings.py draws them"


@pytest.mark.parametrize("name", media.POLICIES)
def test_film_is_of_the_present_policy(name):
    shown = json.loads(media.SOURCES.read_text())[name]
    assert shown == media.policy_hash(name), f"python docs/media.py {name} makes the film anew"
    assert (media.FILMS / f"{name}.webp").exists()


def test_links_between_pages_lead_to_files():
    for page in (*ROOT.glob("*.md"), *ROOT.glob("benchmarks/*.md"), *DOCS.rglob("*.md")):
        if not {"_build", "gallery"} & set(page.parts):
            text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
            for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", text):
                exists = ":" in target or "gallery/" in target or (page.parent / target).exists()
                assert exists, f"{page}: {target}"


def test_files_named_on_the_map_exist():
    text = (DOCS / "develop/index.md").read_text()
    for path in re.findall(r"`((?:torchmpm|dittogym|cfp|baselines|tests|docs|benchmarks)/[\w/.]*)`", text):
        assert (ROOT / path).exists(), path


def test_no_line_of_a_page_is_a_comment():
    """In MyST a line that begins with a percent sign is left out of the page."""
    for page in (*ROOT.glob("*.md"), *DOCS.rglob("*.md")):
        assert not re.search(r"^\s*%", page.read_text(), re.MULTILINE), page


def test_registers_are_those_of_the_present_kernels():
    """Compiled by a version of NVRTC that need not be here."""
    current = json.loads((DOCS / "cuda-kernels.json").read_text())["sources"] == digest_of_sources()
    assert current, "python benchmarks/cuda_kernels.py --out docs/cuda-kernels.json compiles them anew"
