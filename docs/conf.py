"""The site made of these pages: `make docs`, then build/docs/index.html."""

from __future__ import annotations

import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

import msgspec
from sphinx.application import Sphinx

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import reference_pages  # noqa: E402

project = "macs-zenoh"
copyright = "the macs-zenoh authors, Apache-2.0"  # noqa: A001
release = version = version_of("macs-zenoh")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
exclude_patterns = ["Thumbs.db", ".DS_Store"]

html_theme = "furo"
html_title = "macs-zenoh"
html_theme_options = {
    "source_repository": f"{reference_pages.repository()}/",
    "source_branch": "main",
    "source_directory": "docs/",
}

myst_enable_extensions = ["deflist", "attrs_block"]
myst_heading_anchors = 4
# A settings file with "…" in it, or JSON with a comment, is shown as it is; an annotation `type` may be many things.
suppress_warnings = ["misc.highlighting_failure", "ref.python"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True

linkcheck_ignore = [r"https?://(localhost|127\.0\.0\.1).*", reference_pages.repository() + r".*"]


def write_pages(app: Sphinx) -> None:
    """Write what is generated from the code, before anything is read."""
    folder = HERE / "generated"
    folder.mkdir(exist_ok=True)
    for name, text in reference_pages.pages().items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def lead_inside(app: Sphinx, name: str, source: list[str]) -> None:
    """Pages link to files of the repository: to pages of this site, where those are here, else to where it is kept."""
    source[0] = reference_pages.links_of_site(source[0], name)


def code_as_written(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Docstrings write `name` for code, also before letters (`advertise`d), where reStructuredText wants a space."""
    text = re.sub(r"(?<![`:\w])`([^`\n]+)`(?!`)(\w?)", lambda code: _code(*code.groups()), "\n".join(lines))
    text = re.sub(r"^Alias for field number \d+$", "", text, flags=re.MULTILINE)  # Python's own, of named tuples
    text = re.sub(r"^(Args|Raises):\n((?:    .*\n?)+)", _fields, text, flags=re.MULTILINE)
    lines[:] = text.split("\n")


def _fields(section: re.Match[str]) -> str:
    """A section of names with texts, as reStructuredText has it."""
    kind = {"Args": "param", "Raises": "raises"}[section[1]]
    return "\n" + re.sub(r"^    (\w+): ", rf":{kind} \1: ", section[2], flags=re.MULTILINE)


def _code(code: str, letter: str) -> str:
    return f"``{code}``" + (f"\\ {letter}" if letter else "")


def signature(app: Sphinx, what: str, name: str, value: Any, *_: Any) -> tuple[str, None] | None:
    """Structs have a field for each parameter, with ranges: too much for a line."""
    return ("(…)", None) if isinstance(value, type) and issubclass(value, msgspec.Struct) else None


def no_edit_of_generated(app: Sphinx, name: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """What is made from the code has no file in the repository to edit."""
    if name.startswith("generated/"):
        context["page_source_suffix"] = ""


def setup(app: Sphinx) -> None:
    app.connect("html-page-context", no_edit_of_generated)
    app.connect("autodoc-process-signature", signature)
    app.connect("autodoc-process-docstring", code_as_written)
    app.connect("builder-inited", write_pages)
    app.connect("source-read", lead_inside)
