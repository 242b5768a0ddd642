"""What people read: whole and plain in a pipe, coloured and within its width on a terminal, never others' markup."""

from __future__ import annotations

import io
import re

import pytest

from bridge.cli import terminal
from bridge.cli.terminal import BAD, Block, Columns
from tests.unit.test_doctor_analyze import Terminal

NAME = "[bold]x[/bold] :smile: \x1b[31mred\x1b[0m [link=http://x]y[/link]"
LONG = "word " * 60 + "a" * 300


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def piped(*blocks: Block) -> str:
    return terminal.drawn(blocks, io.StringIO())


def on_terminal(*blocks: Block) -> str:
    return terminal.drawn(blocks, Terminal())


def without_colours(text: str) -> str:
    return re.sub(r"\x1b\[[0-9;]*m", "", text)


def test_a_pipe_gets_each_row_in_one_plain_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is cut off, wrapped, drawn around or coloured, and nothing hangs at the end of a line, whatever width a
    terminal somewhere has."""
    monkeypatch.setenv("COLUMNS", "40")
    rows = [("ros", "7", LONG, ("stopped", BAD)), ("unity", "256", "x", "")]
    lines = piped(Columns(rows, headings=("TYPE", "ID", "NAME", "STATE"), right={1}), "", (LONG, BAD)).split("\n")
    assert len(lines) == 5
    assert lines[0].startswith("TYPE    ID  NAME")
    assert lines[1] == f"ros      7  {LONG}  stopped"
    assert lines[2] == "unity  256  x"
    assert lines[4] == LONG


def test_a_terminal_gets_all_of_it_within_its_width(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too long goes on in the next line of its column."""
    monkeypatch.setenv("COLUMNS", "50")
    lines = without_colours(on_terminal(Columns([("ros", LONG)], headings=("TYPE", "NAME")))).splitlines()
    assert max(map(len, lines)) <= 50
    assert "".join("".join(lines).split()) == "TYPENAMEros" + "".join(LONG.split())


@pytest.mark.parametrize(
    ("variables", "in_pipe", "coloured"),
    [
        ({}, False, True),
        ({}, True, False),
        ({"NO_COLOR": "1"}, False, False),
        ({"FORCE_COLOR": "1"}, True, True),
        ({"TERM": "dumb"}, False, False),
    ],
)
def test_colours_as_everywhere(
    variables: dict[str, str], in_pipe: bool, coloured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a terminal that can, unless NO_COLOR; elsewhere only with FORCE_COLOR, which cuts nothing off."""
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    text = (piped if in_pipe else on_terminal)((LONG if in_pipe else "text", BAD))
    assert ("31m" in text) is coloured
    assert without_colours(text) == (LONG if in_pipe else "text")


@pytest.mark.parametrize("draw", [piped, on_terminal])
def test_what_others_said_is_text(draw: object, monkeypatch: pytest.MonkeyPatch) -> None:
    """Markup, emoji names and escapes of others are shown as they are written, in every kind of block."""
    assert callable(draw)
    monkeypatch.setenv("COLUMNS", "200")
    shown = draw(NAME, (NAME, BAD), Columns([(NAME, (NAME, BAD))], headings=(NAME,), indent=4))
    harmless = NAME.replace("\x1b", "\\x1b")
    assert without_colours(shown).count(harmless) == 5
    assert "\x1b[31mred" not in shown


def test_progress_is_for_a_terminal_only(capsys: pytest.CaptureFixture[str]) -> None:
    """A pipe's stderr gets nothing of it."""
    with terminal.progress() as tell:
        tell("[bold]x", 1, 2)
    assert capsys.readouterr().err == ""


def test_progress_is_gone_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """It says what is done now, as text, and takes its line back."""
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    with terminal.progress() as tell:
        tell("[bold]x \x1b[2J", 1, 2)
        tell("y", 2, 2)
    said = stream.getvalue()
    assert "[bold]x \\x1b[2J" in without_colours(said)
    assert "1/2" in without_colours(said)
    assert said.endswith("\x1b[2K") or said.rstrip("\r\n").endswith(("\x1b[2K", "\x1b[?25h"))
