"""The size of files and functions, and the names of classes: what CONTRIBUTING asks of code, counted."""

from __future__ import annotations

import ast
from pathlib import Path

from tests.support.sources import nodes

ROOT = Path(__file__).parents[2]
SOURCES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for folder in ("macs_zenoh", "bridge")
    for path in sorted((ROOT / folder).rglob("*.py"))
}

FILE_LINES = 520
"""500 as a guide; nobody splits a file for its last lines."""
FUNCTION_LINES = 60
"""50 as a guide, docstring and all."""

LARGER = {
    "bridge/gateway/connection.py": "one agent, with its socket or between two",
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


def test_no_file_is_too_large() -> None:
    """Whoever looks for something reads a few screens, not twenty: what is told here is split by subject."""
    lines = {name: len(text.splitlines()) for name, text in SOURCES.items()}
    assert {name: count for name, count in lines.items() if count > FILE_LINES and name not in LARGER} == {}


def test_functions_are_short_and_classes_say_what_they_are() -> None:
    """A function fits on a screen; a class is named for what it is, not for being there."""
    long, vague = {}, []
    for name in SOURCES:
        for node in nodes(ROOT / name):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                if lines > FUNCTION_LINES and f"{name} {node.name}" not in LONGER:
                    long[f"{name} {node.name}"] = lines
            elif isinstance(node, ast.ClassDef) and node.name.endswith(VAGUE) and node.name not in MEANT:
                vague.append(f"{name} {node.name}")
    assert len(SOURCES) > 300
    assert long == {}
    assert vague == []


def test_what_may_be_larger_exists() -> None:
    """No exception is kept for what has gone."""
    for name in {*LARGER, *(known.split()[0] for known in LONGER)}:
        assert (ROOT / name).exists(), name


TIERS = ("ALONE", "FEW", "SOAK")


def test_what_is_in_a_tier_exists() -> None:
    """Each name of a file or of the beginning of a test is one: who renames a test takes it out of no tier unseen."""
    tree = ast.parse((ROOT / "tests" / "support" / "tiers.py").read_text(encoding="utf-8"))
    tiers = {
        node.targets[0].id: ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id in TIERS
    }
    named = [name for tier in TIERS for name in tiers[tier]]
    assert len(named) > 30
    for name in named:
        path, _, test = name.partition("::")
        assert (ROOT / path).exists(), name
        begins = f"def {test.partition('[')[0]}"
        assert not test or begins in (ROOT / path).read_text(encoding="utf-8"), name
