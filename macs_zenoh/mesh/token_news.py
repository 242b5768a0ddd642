"""Tokens that came or ended: from Zenoh to the loop, many at a time.

All that comes over a link comes in one thread of Zenoh's, one after the other, and a callback of ours there waits for
Python's lock. Tokens are what others can bring thousands of in one moment: behind two thousand a command waited for
half a second. So they go into a channel of Zenoh's, which needs no Python, and a thread of ours takes them out.
"""

from __future__ import annotations

import asyncio
import atexit
import logging
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from typing import Any

import zenoh

from .declared import Subscription
from .panics import call

log = logging.getLogger("macs.mesh")

AT_ONCE = 200
"""So many tokens are told of without a break."""
WAITING = 1 << 16
"""So many wait in the channel before Zenoh's thread does."""
GATHER_S = 0.001
"""Pause before the next look for tokens: those that come in a burst wake nobody one by one."""
END_S = 5.0
"""How long the end of a program waits for these threads, which must not be in Zenoh then."""

TokenChange = tuple[str, bool]
"""The key of a token, and whether it lives now."""
OnTokens = Callable[[list[TokenChange]], None]

_watched: weakref.WeakKeyDictionary[Subscription, threading.Thread] = weakref.WeakKeyDictionary()


def watch(liveliness: Any, key: str, on_tokens: OnTokens) -> Subscription:
    """Call ``on_tokens``, in a thread of its own, with the tokens that exist, come or go: all that have since the call
    before, and no empty list. ``liveliness`` is that of a Zenoh session."""
    subscriber = liveliness.declare_subscriber(key, zenoh.handlers.FifoChannel(WAITING), history=True)
    thread = threading.Thread(target=_read, args=(subscriber.handler, on_tokens), name="macs-tokens", daemon=True)
    watching = Subscription(subscriber)
    _watched[watching] = thread
    thread.start()
    return watching


def _read(channel: zenoh.handlers.Handler[zenoh.Sample], on_tokens: OnTokens) -> None:
    while (tokens := call(_some, channel)) is not None:
        try:
            on_tokens(tokens)
        except Exception:  # it must not make this one deaf for all that follow
            log.exception("what came and went was not handled")
        time.sleep(GATHER_S)


def _some(channel: zenoh.handlers.Handler[zenoh.Sample]) -> list[TokenChange] | None:
    """Wait for the next ones; None when nothing is watched any more."""
    tokens: list[TokenChange] = []
    try:
        sample: zenoh.Sample | None = channel.recv()
        while sample is not None:
            tokens.append((str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
            sample = channel.try_recv() if len(tokens) < AT_ONCE else None
    except zenoh.ZError:  # it is closed, and empty
        return tokens or None
    return tokens


def _end_all() -> None:
    """Python ends threads where they are, and Zenoh aborts the program when that is in its midst."""
    for watching, thread in list(_watched.items()):
        watching.close()
        thread.join(END_S)


atexit.register(_end_all)


class TokenNews:
    """Those of one watcher, for the loop, which ``wake`` wakes from any thread. ``on_change(key, alive)`` is called
    there."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        wake: Callable[[Callable[[], None]], None],
        on_change: Callable[[str, bool], None],
    ) -> None:
        self._loop = loop
        self._wake = wake
        self._on_change = on_change
        self._news: deque[TokenChange] = deque()
        self._lock = threading.Lock()
        """Held while it is decided who wakes the loop."""
        self._waking = False

    def receive(self, tokens: list[TokenChange]) -> None:
        """What `watch` calls."""
        with self._lock:
            self._news += tokens
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
