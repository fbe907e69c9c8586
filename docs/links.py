"""Follows every link inside the built site, and from the pages of the repository that are read on their own."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[1]
ALONE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "benchmarks/README.md")


@dataclass
class Page(HTMLParser):
    """Where a page of HTML leads, and its anchors."""

    targets: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note links, pictures, scripts and anchors."""
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.targets.append(value)
            elif name in ("id", "name") and value:
                self.anchors.add(value)


def read(file: Path) -> Page:
    """Read a page."""
    page = Page()
    page.feed(file.read_text())
    return page


def inside(target: str) -> bool:
    """Whether a link stays here."""
    parts = urlsplit(target)
    return not (parts.scheme or parts.netloc)


def dead_in_site(site: Path) -> list[str]:
    """Links of a built site that lead nowhere."""
    pages = {file.resolve(): read(file) for file in site.rglob("*.html")}
    dead = []
    for file, page in pages.items():
        for target in filter(inside, page.targets):
            parts = urlsplit(target)
            place = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            place = place / "index.html" if place.is_dir() else place
            missing = parts.fragment and place in pages and unquote(parts.fragment) not in pages[place].anchors
            if not place.exists() or missing:
                dead.append(f"{file.relative_to(site.resolve())}: {target}")
    return dead


def dead_in_repository() -> list[str]:
    """Relative links of the pages that are read on their own, to files that are not there."""
    dead = []
    for name in ALONE:
        file = ROOT / name
        for target in filter(inside, re.findall(r"\]\(([^)\s]+)\)", file.read_text())):
            if urlsplit(target).path and not (file.parent / urlsplit(target).path).exists():
                dead.append(f"{name}: {target}")
    return dead


if __name__ == "__main__":
    site = Path(sys.argv[1])
    dead = dead_in_site(site) + dead_in_repository()
    count = sum(len(read(file).targets) for file in site.rglob("*.html"))
    print("\n".join(dead) or f"{count} links on {len(list(site.rglob('*.html')))} pages, none dead inside")
    sys.exit(bool(dead))
