"""Tokens that are declared together where many are wanted within moments. Asyncio.

One that is declared by itself wakes Zenoh's sending thread, and has a packet of its own here, in the router and at
everybody who watches: 170 us of this process, against 60 where some are declared together. A router takes 0.5 to 1 ms
for each, in the thread that reads all that comes from here: behind a thousand in a second a command was 0.2 s late. So
only so many are declared in a second (all measured, Zenoh 1.10.2).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from .declared import Token

log = logging.getLogger("macs.mesh")

GATHER_S = 0.01
"""So long after one was declared others wait, for those that come behind them."""
AT_ONCE = 5
"""So many are declared then, and the next as many so much later."""


class GatheredTokens:
    """The first is declared at once, and so is one that nothing came before for a while."""

    def __init__(self, declare: Callable[[str], Token]) -> None:
        self._declare = declare
        self._waiting: dict[Token, str] = {}
        """Those that are not there yet and their keys, the first first."""
        self._gathering: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        """How many wait."""
        return len(self._waiting)

    def declare(self, key: str) -> Token:
        """A token that will be there as soon as it is its turn, unless it is closed before."""
        if self._gathering is None:
            self._gather()
            return self._declare(key)
        token = Token(_WAITS)
        self._waiting[token] = key
        return token

    def declare_now(self, token: Token) -> None:
        """Declare this one, if it waits: before its turn."""
        key = self._waiting.pop(token, None)
        if key is None or not token.is_open:
            return
        try:
            token.become(self._declare(key))
        except Exception:  # one that cannot be declared must not cost others theirs, nor what one of them says
            log.exception("%s cannot be declared", key)

    def waiting(self, token: Token) -> str | None:
        """Its key, while it is not declared yet."""
        return self._waiting.get(token)

    def close(self) -> None:
        """Declare nothing any more."""
        if self._gathering is not None:
            self._gathering.cancel()
        self._waiting.clear()

    def _gather(self) -> None:
        self._gathering = asyncio.get_running_loop().call_later(GATHER_S, self._gathered)

    def _gathered(self) -> None:
        self._gathering = None
        declared = 0
        while self._waiting and declared < AT_ONCE:
            token = next(iter(self._waiting))
            declared += token.is_open
            self.declare_now(token)
        if declared:
            self._gather()


class _Waits:
    """In the place of what is not declared yet."""

    def undeclare(self) -> None:
        """It is not wanted any more."""


_WAITS = _Waits()
