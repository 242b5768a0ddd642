"""Leaving a Zenoh network for certain."""

from __future__ import annotations

import asyncio
from collections.abc import Callable


async def leave(close: Callable[[], object]) -> None:
    """Call ``close``, which blocks, in a thread, and wait for its end even if that is cancelled: a process that exits
    with an open session hangs. Raises CancelledError afterwards, if it was."""
    closing = asyncio.ensure_future(asyncio.to_thread(close))
    cancelled = False
    while not closing.done():
        try:
            await asyncio.shield(closing)
        except asyncio.CancelledError:
            cancelled = True
    if cancelled:
        raise asyncio.CancelledError
