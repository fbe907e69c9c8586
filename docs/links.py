"""Checks the internal links of the built site; a test checks those of the Markdown files."""

from __future__ import annotations

import argparse
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """Link targets and anchors of an HTML page."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(file.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect links, images, scripts and anchors."""
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.targets.append(value)
            elif name in ("id", "name") and value:
                self.anchors.add(value)


def is_relative(target: str) -> bool:
    """Whether a link is relative."""
    parts = urlsplit(target)
    return not (parts.scheme or parts.netloc)


def broken_in_site(site: Path, pages: dict[Path, Page]) -> list[str]:
    """Broken links of a built site."""
    broken = []
    for file, page in pages.items():
        for target in filter(is_relative, page.targets):
            parts = urlsplit(target)
            place = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            place = place / "index.html" if place.is_dir() else place
            missing = parts.fragment and place in pages and unquote(parts.fragment) not in pages[place].anchors
            if not place.exists() or missing:
                broken.append(f"{file.relative_to(site)}: {target}")
    return broken


def main() -> int:
    """Print the broken links of the site in the folder that the command names; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("site", type=Path, help="folder of the built site")
    site = parser.parse_args().site.resolve()
    pages = {file: Page(file) for file in site.rglob("*.html")}
    broken = broken_in_site(site, pages)
    count = sum(len(page.targets) for page in pages.values())
    print("\n".join(broken) or f"{count} links on {len(pages)} pages, none broken")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main())
