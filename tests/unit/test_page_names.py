"""What pages name is there: files, commands with their options, and words of the code."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from functools import cache
from pathlib import Path

import pytest

from bridge.cli import build_parser

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path for path in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")] if path.name != "CHANGELOG.md"
)  # which tells of names that are gone
FOLDERS = ("macs_zenoh", "bridge", "config", "tests", "benchmarks", "examples", "interfaces")
NOT_OURS = {
    *("nd__turn", "OnApplicationPause", "AmbientCapabilities", "CapabilityBoundingSet", "CAP_NET_BIND_SERVICE"),
    "TasksMax",
    *("call_failed", "call_invalid"),  # made of call_ and the kind of failure
    *("cmd_vel_timeout", "rmw_zenohd"),  # of ROS
}
"""Examples, and words of Unity, systemd and Linux."""
FOR_EXAMPLE = {
    "SHELL": "bash",
    "ID": "7",
    "N": "7",
    "ROBOT": "7",
    "HOST:PORT": "127.0.0.1:7000",
    "TYPE/ID": "ros/7",
    "VERB": "online",
}
"""Words in capital letters that stand for something."""


def inline(path: Path) -> list[str]:
    """Code in the sentences and tables of a page."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    return re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text)


def typed(path: Path) -> list[str]:
    """Commands in blocks of a page."""
    blocks = re.findall(r"```\w*\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line.strip().removeprefix("$ ") for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    return [line for line in lines if re.match(r"macs [a-z]", line)]


@cache
def words_of_the_code() -> frozenset[str]:
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.is_file()]
    files += [ROOT / "Makefile", ROOT / "pyproject.toml", ROOT / ".ci" / "run"]
    texts = (path.read_text(encoding="utf-8", errors="replace") for path in files if path != Path(__file__))
    words = frozenset(word for text in texts for word in re.findall(r"\w+", text))
    words |= {f"{word}_total" for word in words if word.startswith("macs_")}  # as Prometheus calls counters
    return words | {word.lower() for word in words} | {path.stem for path in files}  # counters are names of outcomes


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_files_that_a_page_names_exist(path: Path) -> None:
    """A file or folder of the repository in a sentence is there."""
    folders = "|".join((*FOLDERS, "docs"))
    named = {name for code in inline(path) for name in re.findall(rf"(?<![\w/.-])(?:{folders})/[\w./-]*\w", code)}
    assert [name for name in named if not (ROOT / name).exists() and not list(ROOT.glob(f"{name}.*"))] == []


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_words_that_a_page_names_are_words_of_the_code(path: Path) -> None:
    """A name with an underscore or a capital inside it, in code, is still one somewhere."""
    names = {name for code in inline(path) for name in re.findall(r"\b[A-Za-z]\w*[A-Za-z0-9]\b", code)}
    coined = {name for name in names if "_" in name or re.search(r"[a-z][A-Z]", name)}
    assert coined - words_of_the_code() - NOT_OURS == set()


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_commands_on_a_page_are_commands(path: Path) -> None:
    """The command line takes each command of a page, or it names a verb and leaves the rest out."""
    for command in [*(code for code in inline(path) if re.match(r"macs [a-z]", code)), *typed(path)]:
        plain = re.sub(r"[\[\]]|\.\.\.(?=\])| \.\.\.", "", re.split(r" [|>] | && |…", command)[0])
        words = [FOR_EXAMPLE.get(word, word) for word in shlex.split(plain, comments=True)[1:]]
        said, problem = io.StringIO(), None
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            try:
                build_parser(words[0] if words else "").parse_args(words)
            except SystemExit as end:
                problem = said.getvalue().splitlines()[-1] if end.code else None
        if problem is not None:
            assert "the following arguments are required" in problem, command


def test_what_logs_are_quoted_to_say_they_say() -> None:
    """On the page of troubles, what stands in a log is a text of the sources, but for its numbers."""
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "bridge").rglob("*.py"))
    text += "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "macs_zenoh").rglob("*.py"))
    page = ROOT / "docs" / "troubleshooting.md"
    quoted = [code for code in inline(page) if re.match(r"[a-z]+ [a-z]+ ", code) and not code.startswith("macs ")]
    ours = [code for code in quoted if not code.startswith(("ros2 ", "apt "))]
    assert len(ours) >= 4
    for code in ours:
        parts = [part.strip() for part in re.split(r"\d+ s|…|\.allow", code)]
        assert [part for part in parts if part and part not in text] == [], code
