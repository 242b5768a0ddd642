"""Waiting for what must happen, and saying what was seen instead when it does not.

No test waits for a time, and none fails because a machine is busy: what holds costs the moment in which it comes
about, however long it might have taken.
"""

from __future__ import annotations

import ast
import asyncio
import builtins
import inspect
import textwrap
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any, TypeVar

PATIENCE_S = 60.0
"""How long something may take that takes a moment on a machine with nothing else to do."""
SHOWN = 400
"""How many characters of a value are shown."""

T = TypeVar("T")


async def until(condition: Callable[[], Any], timeout_s: float = PATIENCE_S, *, every_s: float = 0.005) -> Any:
    """Wait until the condition, a function or a coroutine function, holds; what it returned. AssertionError with what
    was seen last when it does not come to hold."""
    deadline = time.monotonic() + timeout_s
    while True:
        seen = condition()
        if inspect.isawaitable(seen):
            seen = await seen
        if seen:
            return seen
        assert time.monotonic() < deadline, f"not within {timeout_s:g} s: {described(condition, seen)}"
        await asyncio.sleep(every_s)


async def first_of(coming: Awaitable[T], act: Callable[[], None], *, every_s: float = 0.05) -> T:
    """Repeat an action until what it brings about has come, as a message: a busy link drops topic data."""
    task, deadline = asyncio.ensure_future(coming), time.monotonic() + PATIENCE_S
    while not task.done():
        assert time.monotonic() < deadline, "nothing has come"
        act()
        await asyncio.wait([task], timeout=every_s)
    return task.result()


async def get(queue: asyncio.Queue[Any], timeout_s: float = PATIENCE_S) -> Any:
    """The next item of a queue; fail when there is none."""
    return await asyncio.wait_for(queue.get(), timeout_s)


def described(condition: Callable[[], Any], seen: Any) -> str:
    """The condition as it is written, and what its parts are now."""
    body = _body(condition)
    if body is None:
        return f"{getattr(condition, '__qualname__', condition)} is {_shown(seen)}"
    names = {**vars(builtins), **condition.__globals__, **inspect.getclosurevars(condition).nonlocals}
    parts = []
    for part in _parts(body):
        text = ast.unparse(part)
        try:
            parts.append(f"{text} is {_shown(eval(text, names))}")
        except Exception:  # noqa: BLE001 - of an item of a loop, say, or gone since; the others are shown
            continue
    return "; ".join([ast.unparse(body), *dict.fromkeys(parts)])


def _body(condition: Callable[[], Any]) -> ast.expr | None:
    """The expression of a lambda; None of anything else."""
    if getattr(condition, "__name__", "") != "<lambda>":
        return None
    try:
        text = textwrap.dedent(inspect.getsource(condition))
    except (OSError, TypeError):
        return None
    text = text[text.index("lambda") :].strip() if "lambda" in text else ""
    for end in range(len(text), 0, -1):  # behind it is the rest of the call
        try:
            tree = ast.parse(text[:end], mode="eval")
        except SyntaxError:
            continue
        return next((node.body for node in ast.walk(tree) if isinstance(node, ast.Lambda)), None)
    return None


def _parts(node: ast.expr) -> Iterator[ast.expr]:
    """What a condition compares, combines or looks through."""
    if isinstance(node, ast.Compare):
        inner = [node.left, *node.comparators]
    elif isinstance(node, ast.BoolOp):
        inner = node.values
    elif isinstance(node, ast.UnaryOp):
        inner = [node.operand]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and hasattr(builtins, node.func.id):
        inner = node.args
    elif isinstance(node, ast.GeneratorExp | ast.ListComp | ast.SetComp):
        inner = [node.generators[0].iter]
    elif isinstance(node, ast.Constant):
        return
    else:
        yield node
        return
    for part in inner:
        yield from _parts(part)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}… ({len(text)} characters)"
