"""The tree of errors is drawn as it is, and whoever raises one of ours raises one of that tree."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from macs_zenoh import errors
from macs_zenoh.errors import MacsError
from tests.support.sources import nodes

ROOT = Path(__file__).parents[2]
INTERNAL = {
    "CallFailed",
    "CutOff",
    "Misfit",
    "NoLibraries",
    "NotOfType",
    "OutputLost",
    "TooManyParts",
    "_OwnFiles",
    "_TooLong",
}
"""Raised and caught within one package; no user sees them."""


def drawn() -> dict[str, str]:
    """Each error of the drawing at the top of errors.py, with the one that it hangs on."""
    parents, above = {}, {}
    for bars, name in re.findall(r"^    ([│├└─ ]*)(\w+)", errors.__doc__ or "", re.MULTILINE):
        depth = len(bars) // 4
        above[depth] = name
        parents[name] = above.get(depth - 1, "")
    return parents


def test_the_drawing_is_the_tree() -> None:
    """Every error of the module is drawn under its own parent, and no other."""
    kinds = {name: kind for name, kind in vars(errors).items() if isinstance(kind, type)}
    tree = {name: kind.__mro__[1].__name__ for name, kind in kinds.items() if issubclass(kind, MacsError)}
    assert drawn() == {**tree, "MacsError": ""}


def test_errors_of_other_modules_hang_on_the_tree() -> None:
    """What another module defines and a user can see is caught by ``except MacsError``."""
    known = set(drawn())
    for path in sorted([*(ROOT / "macs_zenoh").rglob("*.py"), *(ROOT / "bridge").rglob("*.py")]):
        for node in nodes(path):
            bases = _bases(node) if isinstance(node, ast.ClassDef) else set()
            if isinstance(node, ast.ClassDef) and (bases & known or any(map(_is_error, bases))):
                assert bases & known or node.name in INTERNAL | {"MacsError"}, f"{path.name}: {node.name}"


def _is_error(name: str) -> bool:
    return name.endswith(("Error", "Exception"))


def _bases(node: ast.ClassDef) -> set[str]:
    return {base.attr if isinstance(base, ast.Attribute) else getattr(base, "id", "") for base in node.bases}
