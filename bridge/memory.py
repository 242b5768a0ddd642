"""Memory that large frames took is given back when they are gone."""

from __future__ import annotations

import asyncio
import ctypes
import resource
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

LOOK_S = 1.0
AGAIN_S = 10.0
"""So long after it was done it is not done again: what is needed all the time comes back at once, and that costs."""

SPARE_BYTES = 32 << 20
"""It is done when a program has so much more than it had at least."""


@contextmanager
def given_back() -> Iterator[None]:
    """Meanwhile give back what the C library keeps for itself (glibc).

    After a few frames of 31 MiB a program kept 60 to 400 MiB that nobody used. To hold the library to fixed thresholds
    instead (``mallopt``) costs 5 to 10 % of what a gateway can pass on.
    """
    looking = asyncio.create_task(_look())
    try:
        yield
    finally:
        looking.cancel()


async def _look() -> None:
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
    if trim is None:
        return
    with suppress(OSError):  # there is no /proc
        least = _used_bytes()
        while True:
            await asyncio.sleep(LOOK_S)
            if _used_bytes() > least + SPARE_BYTES:
                await asyncio.to_thread(trim, 0)
                least = _used_bytes()
                await asyncio.sleep(AGAIN_S)
            least = min(least, _used_bytes())


def _used_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
