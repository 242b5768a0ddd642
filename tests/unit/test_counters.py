"""docs/counters.md has every counter of the sources, with what it means and what to do, and no other."""

from __future__ import annotations

import re
from pathlib import Path

from reference_pages import sources, where_counted

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "counters.md").read_text(encoding="utf-8")
FIGURES = {"sent", "received", "on_topic", "own", "for_others", "from_topic", "delivered_here", "second_copy"} | {
    "last_values",
    "repeated",
}
"""Counted by collective awareness, and no losses: docs/awareness.md."""


def rows() -> dict[str, tuple[str, str]]:
    """The page's tables: each counter with its meaning and its remedy."""
    found = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| ([^|]+) \| ([^|]+) \|$", PAGE, re.MULTILINE)
    return {name: (means, todo) for names, means, todo in found for name in re.findall(r"\w+", names)}


def test_every_counter_is_on_the_page() -> None:
    """What a log line says that it is counted as can be looked up."""
    counted = set(where_counted())
    assert len(counted) > 40
    assert counted - FIGURES - set(rows()) == set()


def test_every_counter_on_the_page_is_one() -> None:
    """No row is about a name that no source has; each says something."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources())
    words = set(re.findall(r"\w+", text))
    for name, (means, todo) in rows().items():
        assert name in words or (name.startswith("call_") and f'"{name[5:]}"' in text), name
        assert len(means.strip()) > 5, name
        assert todo.strip(), name
