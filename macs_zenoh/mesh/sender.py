"""A thread that puts what is large: on a slow link that takes long."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence

from macs_zenoh.losses import Losses

from .declared import Outlet, Payload

LARGE_BYTES = 128 << 10
"""Larger ones are given to Zenoh by a thread."""


def is_large(payload: Payload) -> bool:
    """Whether a thread puts it."""
    return len(payload) > LARGE_BYTES


class Sender:
    """A thread that puts what may take long, in order. It starts with the first such payload.

    So long as ``most_s`` a large payload may wait while others wait behind it; then it is not put, and ``on_late``
    called. One that cannot be put, for a reason that nobody thought of, costs itself (``failed`` in ``drops``). Where
    there can be no more threads, whoever puts does it himself (``no_thread``).
    """

    def __init__(
        self,
        limit_bytes: int,
        put: Callable[[Outlet, Payload], None],
        on_room: Callable[[], None],
        drops: Losses,
        on_late: Callable[[], None] = lambda: None,
        most_s: float = math.inf,
    ) -> None:
        self._drops = drops
        self._most_s = most_s
        self._on_late = on_late
        self._put = put
        self.backlogged = False
        self.sent = 0
        self._limit_bytes = limit_bytes
        self._on_room = on_room
        self._bytes = 0
        self._queue: deque[tuple[Outlet, Payload, str, float] | Callable[[], None]] = deque()
        """What is to be put, and who is to be told that all before it has been."""
        self._keys: Counter[str] = Counter()
        """How much waits of those that whoever puts has named."""
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closing = False

    @property
    def bytes(self) -> int:
        """How much waits."""
        return self._bytes

    @property
    def idle(self) -> bool:
        """Nothing is waiting or being sent."""
        return self._bytes == 0

    def has(self, key: str) -> bool:
        """Whether anything with this key is waiting or being sent."""
        return key in self._keys

    def put(self, publisher: Outlet, payload: Payload, key: str = "") -> bool:
        """Queue it; False when that would be more than the limit (one payload may always wait), or than twice as much
        of small ones with a ``key``, which is for `has`."""
        limit = self._limit_bytes * (2 if key and not is_large(payload) else 1)
        with self._wake:
            if self._closing or (self._bytes and self._bytes + len(payload) > limit):
                return False
            self._bytes += len(payload)
            self.backlogged = self._bytes > self._limit_bytes // 4
            self._queue.append((publisher, payload, key, time.monotonic()))
            self._keys[key] += 1
            has_thread = self._thread is not None or self._start()
            self._wake.notify()
        if not has_thread:
            while self._put_one(waits=False):
                pass
        return True

    def _start(self) -> bool:
        thread = threading.Thread(target=self._run, name="macs-sender", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # the next one tries again
            self._drops.once("no_thread", "what is large holds up everything: no thread can put it: %s", error)
            return False
        self._thread = thread
        return True

    def when_sent(self, callback: Callable[[], None]) -> None:
        """Call ``callback``, in any thread, when all that is queued now has been put."""
        with self._wake:
            if not self.idle:
                self._queue.append(callback)
                return
        callback()

    def end(self) -> None:
        """Send what is queued, and end."""
        with self._wake:
            self._closing = True
            self._wake.notify()

    def close(self, timeout_s: float) -> None:
        """The same, and wait for that, for at most ``timeout_s``."""
        self.end()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        while self._put_one(waits=True):
            pass

    def _put_one(self, *, waits: bool) -> bool:
        """Put what is next, or tell whoever is; False when there is nothing, where that ends it."""
        with self._wake:
            while not self._queue:
                if self._closing or not waits:
                    return False
                self._wake.wait()
            entry = self._queue.popleft()
        try:
            self._handle(entry)
        except Exception:  # noqa: BLE001 - it is logged
            text = "what a thread was to put, or to tell, failed"
            self._drops.once("failed", text, level=logging.ERROR, exc_info=True)
        if isinstance(entry, tuple):
            self._has_put(len(entry[1]), entry[2])
        return True

    def _has_put(self, size: int, key: str) -> None:
        with self._wake:
            self.sent += 1
            self._keys[key] -= 1
            if not self._keys[key]:
                del self._keys[key]
            self._bytes -= size
            relieved = self.backlogged and self._bytes < self._limit_bytes // 8
            if relieved:
                self.backlogged = False
        if relieved:
            self._on_room()

    def _handle(self, entry: tuple[Outlet, Payload, str, float] | Callable[[], None]) -> None:
        if not isinstance(entry, tuple):
            entry()
            return
        publisher, payload, _, since = entry
        if self._queue and is_large(payload) and time.monotonic() - since > self._most_s:
            self._on_late()
        else:
            self._put(publisher, payload)


def close_together(senders: Sequence[Sender], timeout_s: float) -> None:
    """Close them all within this time: each sends what it has while the others do."""
    ends_at = time.monotonic() + timeout_s
    for sender in senders:
        sender.end()
    for sender in senders:
        sender.close(max(0.0, ends_at - time.monotonic()))
