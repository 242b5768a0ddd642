"""The size of files and functions, and the names of classes: what CONTRIBUTING asks of code, counted."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULES = sorted(path for folder in ("macs_zenoh", "bridge") for path in (ROOT / folder).rglob("*.py"))

FILE_LINES = 520
"""500 as a guide; nobody splits a file for its last lines."""
FUNCTION_LINES = 60
"""50 as a guide, docstring and all."""

LARGER = {
    "bridge/gateway/server.py": "where a gateway's parts are put together, and each event finds its part",
    "bridge/gateway/connection.py": "one agent, with its socket or between two",
    "bridge/gateway/web.py": "one port with its pages, login and WebSocket",
    "bridge/headset/client.py": "all that a headset can do is one class to its users",
    "bridge/ros/nodes.py": "one table of nodes, and what waits for them under the same lock",
    "macs_zenoh/protocol/tcp_agent.py": "one state machine",
}
"""Files that are larger, and why."""
LONGER = {
    "bridge/gateway/connection.py __init__": "the list of all that is known of a connection",
    "bridge/gateway/server.py __init__": "the list of a gateway's parts",
    "macs_zenoh/protocol/tcp_agent.py __init__": "the list of all that is known of an agent",
}
"""Functions that are longer, and why."""

VAGUE = ("Helper", "Handler", "Manager", "Util", "Utils")
MEANT = {"Manager", "UnknownManager"}
"""The wire's own word for a kind of management data."""


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_is_not_too_large(path: Path) -> None:
    """Whoever looks for something reads a few screens, not twenty."""
    name = str(path.relative_to(ROOT))
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= FILE_LINES or name in LARGER, f"{name} has {len(lines)} lines: split it by subject"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_functions_are_short_and_classes_say_what_they_are(path: Path) -> None:
    """A function fits on a screen; a class is named for what it is, not for being there."""
    name = str(path.relative_to(ROOT))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or 0) - node.lineno + 1
            assert lines <= FUNCTION_LINES or f"{name} {node.name}" in LONGER, f"{name}: {node.name} has {lines} lines"
        elif isinstance(node, ast.ClassDef):
            assert not node.name.endswith(VAGUE) or node.name in MEANT, f"{name}: what is a {node.name}?"


def test_what_may_be_larger_exists() -> None:
    """No exception is kept for what has gone."""
    for name in {*LARGER, *(known.split()[0] for known in LONGER)}:
        assert (ROOT / name).exists(), name
