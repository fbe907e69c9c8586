"""Sphinx configuration. Build with ``make docs``, or ``make docs-tutorials``, which also runs the tutorials."""

import contextlib
import io
import os
import pkgutil
import re
import sys
from unittest import mock

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.util.docutils import SphinxDirective

import torchmpm
from baselines import console

#: Names of the packages in code.
NAME = re.compile(r"(torchmpm|dittogym|cfp|baselines)(\.\w+)+")

project = "torchmpm"
author = "The torchmpm authors"
copyright = f"2026, {author}"
version = release = torchmpm.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "sphinx-mathjax-offline",  # formulas without a network; the site opens from disk
]
exclude_patterns = ["_build", "sg_execution_times.rst"]
sphinx_gallery_conf = {
    "examples_dirs": "../examples/tutorials",
    "gallery_dirs": "gallery",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "min_reported_time": 1,
    "plot_gallery": os.environ.get("TUTORIALS") == "run",  # otherwise their pages keep the output of the last time
    "parallel": os.cpu_count(),
}
suppress_warnings = ["config.cache"]
nitpicky = True
#: Types of other libraries.
nitpick_ignore_regex = [
    (r"py:class", r"(?!(torchmpm|dittogym|cfp|baselines)\.).*"),
    (r"py:.*", r"(gymnasium|torch)\..*"),
]
default_role = "code"
html_theme = "furo"
html_title = "torchmpm"
html_static_path = ["_static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autoclass_content = "class"
napoleon_numpy_docstring = False
napoleon_use_ivar = True


class CommandHelp(SphinxDirective):
    """Show the output of ``torchmpm PROGRAM OPTIONS --help``, so that the page is always up to date."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Run the command and show its output as a literal block."""
        self.env.note_reread()  # the program may have changed even if the page has not
        written = io.BytesIO()
        shown = io.TextIOWrapper(written, "utf-8", write_through=True)  # whose encoding allows frames
        appearance = {"COLUMNS": "88", "NO_COLOR": "1", "TERM": "dumb"}
        untouched = mock.patch.multiple(sys, argv=[], path=[*sys.path])
        with untouched, mock.patch.dict(os.environ, appearance), contextlib.redirect_stdout(shown):
            try:  # in this process: it has imported the packages already, which takes seconds
                code = console.main([*self.arguments[0].split(), "--help"])
            except SystemExit as end:
                code = end.code
        text = written.getvalue().decode()
        if code:
            raise self.error(f"torchmpm {self.arguments[0]} --help failed:\n{text}")
        return [nodes.literal_block(text=text)]


class LinkNames(SphinxTransform):
    """Links names in code, such as ``dittogym.TorchEnv``, to the reference, so that pages need no roles."""

    default_priority = 5  # before references are resolved

    def apply(self) -> None:
        """Turn them into references, which stay plain code where the reference has no such name."""
        for node in list(self.document.findall(nodes.literal)):
            name = node.astext().removesuffix("()")
            linked = isinstance(node.parent, nodes.reference | nodes.title | addnodes.pending_xref)
            if NAME.fullmatch(name) and not linked and self.env.docname != "changelog":  # names of the past
                reference = addnodes.pending_xref("", refdomain="py", reftype="obj", reftarget=name)
                node.replace_self(reference)
                reference += node


class KeepColons:
    """Restores docstrings of attributes and data, in which Napoleon takes the words before a colon for a type."""

    def __init__(self, app: Sphinx) -> None:
        self.docstrings: dict[str, list[str]] = {}
        app.connect("autodoc-process-docstring", self.before, priority=400)
        app.connect("autodoc-process-docstring", self.after, priority=600)

    def before(self, app: Sphinx, what: str, name: str, item: object, options: object, lines: list[str]) -> None:
        """Store the docstring before Napoleon processes it."""
        if what in ("attribute", "data"):
            self.docstrings[name] = lines.copy()

    def after(self, app: Sphinx, what: str, name: str, item: object, options: object, lines: list[str]) -> None:
        """Restore it."""
        lines[:] = self.docstrings.pop(name, lines)


def drop_protocol_signature(
    app: Sphinx, what: str, name: str, item: object, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Drop the signature ``(*args, **kwargs)`` of protocols, of which nobody makes instances."""
    return ("" if getattr(item, "_is_protocol", False) else signature), returns


def accept_undocumented(app: Sphinx, env: object, node: nodes.Element, content: nodes.Node) -> nodes.Node | None:
    """Accept references to names of the packages that exist but are not on a page; all others remain warnings."""
    target, module, owner = (node.get(key) or "" for key in ("reftarget", "py:module", "py:class"))
    for name in (target, f"{module}.{target}", f"{module}.{owner}.{target}"):
        try:
            pkgutil.resolve_name(name)
        except (AttributeError, ImportError, ValueError):
            continue
        return content
    return None


def drop_links_back(app: Sphinx, page: str, template: str, context: dict[str, object], doctree: object) -> None:
    """Drop links from sources to their documentation, broken for classes that are documented under a public name."""
    if page.startswith("_modules/"):
        context["body"] = re.sub(r'<a class="viewcode-back".*?</a>', "", str(context["body"]))


def setup(app: Sphinx) -> None:
    """Register the extensions of this file."""
    app.connect("html-page-context", drop_links_back)
    app.connect("missing-reference", accept_undocumented)
    app.connect("autodoc-process-signature", drop_protocol_signature)
    KeepColons(app)
    app.add_directive("command-help", CommandHelp)
    app.add_transform(LinkNames)
