"""docs/counters.md has every counter of the sources, with what it means and what to do, and no other."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from macs_zenoh import errors
from macs_zenoh.errors import WireError

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "counters.md").read_text(encoding="utf-8")
SOURCES = [path for folder in ("macs_zenoh", "bridge") for path in (ROOT / folder).rglob("*.py")]
COUNTERS = {"drops", "_drops", "counters", "_counters"}
COUNTING = {"note", "_no", "_lose", "_count", "drop"}
"""Functions whose first argument is the name of a counter, where it is a text."""
FIGURES = {"sent", "received", "on_topic", "own", "for_others", "from_topic", "delivered_here", "second_copy"} | {
    "last_values",
    "repeated",
}
"""Counted by collective awareness, and no losses: docs/awareness.md."""


def _name_of(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def counted(tree: ast.AST) -> Iterator[str]:
    """The names of counters that a module counts up."""
    for node in ast.walk(tree):
        found: ast.AST | None = None
        if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
            if _name_of(node.target.value) in COUNTERS:
                found = node.target.slice
        elif isinstance(node, ast.Call) and node.args and _name_of(node.func) in COUNTING:
            owner = node.func.value if isinstance(node.func, ast.Attribute) else None
            if owner is None or _name_of(owner) in COUNTERS | {"self"}:
                found = node.args[0]
        if isinstance(found, ast.Constant) and isinstance(found.value, str):
            yield found.value


def rows() -> dict[str, tuple[str, str]]:
    """The page's tables: each counter with its meaning and its remedy."""
    found = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| ([^|]+) \| ([^|]+) \|$", PAGE, re.MULTILINE)
    return {name: (means, todo) for names, means, todo in found for name in re.findall(r"\w+", names)}


def test_every_counter_is_on_the_page() -> None:
    """What a log line says that it is counted as can be looked up."""
    names = {name for path in SOURCES for name in counted(ast.parse(path.read_text(encoding="utf-8")))}
    assert len(names) > 40
    refusals = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, WireError)}
    assert (names | refusals) - FIGURES - set(rows()) == set()


def test_every_counter_on_the_page_is_one() -> None:
    """No row is about a name that no source has; each says something."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES)
    for name, (means, todo) in rows().items():
        assert re.search(rf"\b{name}\b", text) or (name.startswith("call_") and f'"{name[5:]}"' in text), name
        assert len(means.strip()) > 5, name
        assert todo.strip(), name
