"""Tokens that came or ended: from Zenoh's threads to the loop, many at a time."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable

import zenoh

from .threads import keep_attached

AT_ONCE = 200
"""So many tokens are told of without a break."""


class TokenNews:
    """Those of one watcher. ``on_change(key, alive)`` is called on the loop, which ``wake`` wakes from any thread."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        wake: Callable[[Callable[[], None]], None],
        on_change: Callable[[str, bool], None],
    ) -> None:
        self._loop = loop
        self._wake = wake
        self._on_change = on_change
        self._news: deque[tuple[str, bool]] = deque()
        self._lock = threading.Lock()
        """Zenoh calls from more than one thread."""
        self._waking = False

    def receive(self, sample: zenoh.Sample) -> None:
        """What Zenoh calls for each."""
        keep_attached()
        with self._lock:
            self._news.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
            awake, self._waking = self._waking, True
        if not awake:  # to wake the loop for each costs more than the rest
            self._wake(self._tell)

    def _tell(self) -> None:
        try:
            for _ in range(AT_ONCE):
                if not self._news:
                    return
                self._on_change(*self._news.popleft())
        finally:
            with self._lock:
                more = self._waking = bool(self._news)
            if more:
                self._loop.call_soon(self._tell)
