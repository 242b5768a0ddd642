"""Text from others does nothing to a terminal or a log."""

from __future__ import annotations

import ast
import io
import json
import logging
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge import logs
from bridge.cli import output
from macs_zenoh.plain import plain, plain_json, plain_lines

ROOT = Path(__file__).parents[2]

HOSTILE = "a\x1b[2J\x1b]0;title\x07\rb\nc\x9b31m\u202ed\u2028e\x7f\x00\t"


@given(st.text())
def test_nothing_but_letters_is_left(text: str) -> None:
    """Any text is printable afterwards, and printable text is what it was; lines and tabs stay where meant."""
    assert plain(text).isprintable()
    assert all(line.replace("\t", "").isprintable() for line in plain_lines(text).split("\n"))
    if text.isprintable():
        assert plain(text) == text
    assert plain_lines(text).count("\n") == text.count("\n")


@given(st.recursive(st.text() | st.none(), lambda inner: st.dictionaries(st.text(), inner) | st.lists(inner)))
def test_json_means_what_it_meant(value: object) -> None:
    """What a program reads from our JSON is what was said, whatever a terminal shows of it."""
    try:
        written = plain_json(json.dumps(value, ensure_ascii=False))
    except UnicodeEncodeError:
        return
    assert written.isprintable()
    assert json.loads(written) == value


def test_data_is_filtered(capsys: pytest.CaptureFixture[str]) -> None:
    """Neither people nor programs get a control character from us, and complaints are one line."""
    output.say(f"one\ntwo {HOSTILE}")
    output.say(output.as_json({"name": HOSTILE}))
    output.note(f"refused: {HOSTILE}")
    said, complained = capsys.readouterr()
    assert all(line.replace("\t", "").isprintable() for line in said.split("\n"))
    assert json.loads(said.split("\n")[-2]) == {"name": HOSTILE}
    assert all(line.isprintable() for line in complained.replace("\t", "").split("\n"))


def test_a_record_is_one_line() -> None:
    """A name with a line break in it makes no second record, in a message or in a traceback, and no length hurts."""
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logs.PlainFormatter("up | "))
    log = logging.getLogger("macs.test_plain")
    log.propagate = False
    log.addHandler(handler)
    log.warning("robot %s has left", f"x\n12:00:00 I macs.gateway: all is well {HOSTILE}")
    log.warning("%s", "y" * 10_000_000)
    try:
        raise ValueError(f"bad\n12:00:00 I macs.gateway: all is well {HOSTILE}")
    except ValueError:
        log.exception("it failed")
    log.removeHandler(handler)
    first, second, third, *traceback = stream.getvalue().removesuffix("\n").split("\n")
    for line in (first, second, third, *traceback):
        assert line.replace("\t", "").isprintable()
    assert [line.startswith("up | ") for line in (first, second, third)] == [True] * 3
    assert len(second) < 20_000
    assert all(line.startswith("  ") for line in traceback)


WAYS = ("print(", "basicConfig", "Formatter", "stdout", "stderr")
"""One of them is in a file that has such a call."""
LAST = {"print", "basicConfig", "Formatter", "write", "writelines"}


def _last(called: ast.expr) -> str:
    """The last name of what is called."""
    return getattr(called, "attr", "") or getattr(called, "id", "")


def test_there_is_no_other_way_out() -> None:
    """No module of ours prints, or writes to stdout or stderr, but the one that filters; nor sets up a log."""
    found = []
    for path in [*(ROOT / "bridge").rglob("*.py"), *(ROOT / "macs_zenoh").rglob("*.py")]:
        if path in (ROOT / "bridge" / "cli" / "output.py", ROOT / "bridge" / "logs.py"):
            continue
        if path == ROOT / "bridge" / "page" / "libraries.py":  # run while the package is built, without what it needs
            continue
        text = path.read_text(encoding="utf-8")
        if not any(word in text for word in WAYS):
            continue
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Call) and _last(node.func) in LAST:
                called = ast.unparse(node.func)
                if called in ("print", "logging.basicConfig", "logging.Formatter") or called.endswith(
                    ("stdout.write", "stderr.write", "stdout.writelines", "stderr.writelines")
                ):
                    found.append(f"{path.relative_to(ROOT)}:{node.lineno} {called}")
    assert found == []
