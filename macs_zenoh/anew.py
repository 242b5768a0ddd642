"""Tokens that are asked for anew, where some were left out and there is room again (`protocol.room`). Asyncio."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from .mesh import Mesh
from .timeouts import within

PAUSES_S = (0.02, 0.2, 1.0, 5.0)
"""Before each question: whoever made room may be about to make more, and under load an answer leaves some out."""
MORE = 2
"""From which of them it goes on when room is made while it is asked: who makes some all day has everybody ask once a
second."""
SHARE = 0.05
"""A question begins when the last answer has taken at most so much of the time since."""
EMPTY, EMPTY_S = 10, 0.1
"""So often, with a pause, it is asked again where an answer is empty: under load many are."""
AT_ONCE = 200
"""Tokens that are handled without a break."""


class Anew:
    """Asks for the tokens of ``keys``, beside watchers of them; ``on_tokens`` gets them in pieces."""

    def __init__(self, mesh: Mesh, keys: Sequence[str], on_tokens: Callable[[Sequence[str]], None]) -> None:
        self._mesh = mesh
        self._keys = keys
        self._on_tokens = on_tokens
        self._ended: set[str] | None = None
        self._next = 0
        """Which pause is next."""
        self._took_s = 0.0
        """How long the last answer took."""
        self._more = asyncio.Event()
        self._asking: asyncio.Task[None] | None = None

    def ask(self) -> None:
        """Ask soon; not more often than is good for routers, however often this is called."""
        if self._asking is None:
            self._next = 0
            self._asking = asyncio.get_running_loop().create_task(self._ask())
        elif self._next > MORE:
            self._next = MORE
            self._more.set()

    def ended(self, key: str) -> None:
        """A watcher saw the end of a token: an answer that is on its way may still have it."""
        if self._ended is not None:
            self._ended.add(key)

    def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()

    async def _ask(self) -> None:
        asked_at = time.monotonic()
        try:
            while self._next < len(PAUSES_S):
                await self._pause(asked_at)
                self._next += 1
                self._ended = set()
                for keys in self._keys:
                    await self._hand_on(await self._tokens(keys))
                self._ended = None
                asked_at = time.monotonic()
        finally:
            self._ended = self._asking = None

    async def _pause(self, since: float) -> None:
        while (left_s := since + max(PAUSES_S[self._next], self._took_s / SHARE) - time.monotonic()) > 0:
            self._more.clear()
            with suppress(asyncio.TimeoutError):
                await within(self._more.wait(), left_s)

    async def _tokens(self, keys: str) -> list[str]:
        for _ in range(EMPTY):
            began = time.monotonic()
            if found := await self._mesh.tokens(keys):
                self._took_s = time.monotonic() - began
                return found
            await asyncio.sleep(EMPTY_S)
        return []

    async def _hand_on(self, found: list[str]) -> None:
        for first in range(0, len(found), AT_ONCE):
            ended = self._ended or ()
            self._on_tokens([key for key in found[first : first + AT_ONCE] if key not in ended])
            await asyncio.sleep(0)
