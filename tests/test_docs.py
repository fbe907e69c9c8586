"""Tables and pictures of the documents show the committed results, the present code and the present policies."""

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
