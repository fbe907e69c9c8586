"""Sphinx configuration. Build with ``make docs``."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import torchmpm

ROOT = Path(__file__).resolve().parents[1]

project = "torchmpm"
author = "The torchmpm authors"
copyright = f"2026, {author}"
version = release = torchmpm.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax", "sphinx.ext.viewcode"]
exclude_patterns = ["_build", "gallery"]
default_role = "code"
html_theme = "furo"
html_title = "torchmpm"

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autoclass_content = "class"
napoleon_numpy_docstring = False
napoleon_use_ivar = True


class CommandHelp(SphinxDirective):
    """Show what ``python -m MODULE OPTIONS --help`` prints, so that the page cannot fall behind the program."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Run the command and keep its output as a literal block."""
        self.env.note_reread()  # the program may have changed though the page has not
        environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
        command = [sys.executable, "-m", *self.arguments[0].split(), "--help"]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            raise self.error(f"python -m {self.arguments[0]} --help failed:\n{done.stderr}")
        return [nodes.literal_block(text=done.stdout)]


class NamesTable(SphinxDirective):
    """A table of names and their meanings from dictionaries ``package.module.NAME``, so that none is forgotten."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Read the dictionaries and write a line for each entry."""
        self.env.note_reread()
        lines = [".. list-table::", "   :header-rows: 1", "", "   * - Name", "     - Meaning"]
        for path in self.arguments[0].split():
            module, _, name = path.rpartition(".")
            for key, meaning in getattr(importlib.import_module(module), name).items():
                lines += [f"   * - ``{key}``", f"     - {meaning}"]
        return self.parse_text_to_nodes("\n".join(["```{eval-rst}", *lines, "```"]))


def setup(app: Sphinx) -> None:
    """Register the directives."""
    app.add_directive("command-help", CommandHelp)
    app.add_directive("names-table", NamesTable)
