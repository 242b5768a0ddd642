"""CONTRIBUTING.md leads to places that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_each_question_has_a_place() -> None:
    """Every answer is a file, and what to begin at is defined in it."""
    table = PAGE.partition("## Where is …?")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (.+\?) \| `(\S+)` \| `(\w+)`", table, re.MULTILINE)
    assert len(rows) >= 10
    assert len({path for _, path, _ in rows}) >= 10
    for question, path, name in rows:
        source = (ROOT / path).read_text(encoding="utf-8")
        assert re.search(
            rf"^\s*(?:class|export class|def|async def) {name}\b|^\s*{name}\b.* = ", source, re.MULTILINE
        ), question


def test_each_pure_module_has_a_file_of_tests() -> None:
    """A module of the protocol has a test file of its name."""
    tests = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
    modules = (ROOT / "macs_zenoh" / "protocol").glob("[a-z]*.py")
    assert {path.stem for path in modules if f"test_{path.stem}" not in tests} == set()


def test_folders_of_tests_exist() -> None:
    """The folders that the page explains are there."""
    named = set(re.findall(r"`(tests/\w+)`", PAGE))
    assert len(named) >= 5
    assert [folder for folder in named if not (ROOT / folder).is_dir()] == []
