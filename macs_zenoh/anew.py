"""Tokens that are asked for anew, where some were left out and there is room again (`protocol.room`). Asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from .mesh import Mesh

SOON_S = 0.2
"""Pause before the question: whoever made room may be about to make more."""
AGAIN_S = 5.0
"""Pause before the next one: it is asked twice."""
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
        self._left = 0
        self._asking: asyncio.Task[None] | None = None

    def ask(self) -> None:
        """Ask soon; not more often than is good for routers, however often this is called."""
        self._left = 2
        if self._asking is None:
            self._asking = asyncio.get_running_loop().create_task(self._ask())

    def ended(self, key: str) -> None:
        """A watcher saw the end of a token: an answer that is on its way may still have it."""
        if self._ended is not None:
            self._ended.add(key)

    def close(self) -> None:
        """Ask no more."""
        if self._asking is not None:
            self._asking.cancel()

    async def _ask(self) -> None:
        pause_s = SOON_S
        try:
            while self._left:
                await asyncio.sleep(pause_s)
                self._left -= 1
                self._ended = set()
                for keys in self._keys:
                    await self._hand_on(await self._tokens(keys))
                self._ended = None
                pause_s = AGAIN_S
        finally:
            self._ended = self._asking = None

    async def _tokens(self, keys: str) -> list[str]:
        for _ in range(EMPTY):
            if found := await self._mesh.tokens(keys):
                return found
            await asyncio.sleep(EMPTY_S)
        return []

    async def _hand_on(self, found: list[str]) -> None:
        for first in range(0, len(found), AT_ONCE):
            ended = self._ended or ()
            self._on_tokens([key for key in found[first : first + AT_ONCE] if key not in ended])
            await asyncio.sleep(0)
