"""Tokens, from those that an answer names to those that come and go."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Collection

CONFIRM_S = 1.0
"""After so long a watcher has all its first news."""

OnToken = Callable[[str, bool], None]


class Followed:
    """Whoever lives is asked for first, and then watched: while a watcher's first news are on their way, an answer may
    leave some out. Who leaves between the two is in no news, and is let go of a little later.

    ``receive(token, alive)`` is called from any thread.
    """

    def __init__(self, answered: Collection[str], receive: OnToken) -> None:
        """``answered`` are told now; give `told` to a watcher then."""
        self._receive = receive
        self._unseen = set(answered)
        self._lock = threading.Lock()
        for token in answered:
            receive(token, True)

    def told(self, token: str, alive: bool) -> None:
        """A watcher's news."""
        with self._lock:
            self._unseen.discard(token)
        self._receive(token, alive)

    async def confirm(self, ask: Callable[[], Awaitable[Collection[str]]]) -> None:
        """Let go of those whom no watcher has told of, and who are not there any more. It asks twice: under load an
        answer can be empty."""
        await asyncio.sleep(CONFIRM_S)
        for _ in range(2):
            if self._unseen:
                there = await ask()
                with self._lock:
                    self._unseen.difference_update(there)
        with self._lock:  # news of one that comes now waits until it is gone
            for token in self._unseen:
                self._receive(token, False)
            self._unseen.clear()
