"""Files of code as trees, parsed once in a worker for all rules that they are held to."""

from __future__ import annotations

import ast
import gc
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path


@contextmanager
def _no_look_for_garbage() -> Iterator[None]:
    """All files are a million objects, and none of them is garbage: looking for any is most of what they cost."""
    looked = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if looked:
            gc.enable()


@cache
def parsed(path: Path) -> ast.Module:
    """A file's tree."""
    with _no_look_for_garbage():
        return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All that is in it, as `ast.walk` finds it."""
    with _no_look_for_garbage():
        return tuple(ast.walk(parsed(path)))
