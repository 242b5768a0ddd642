"""What a recording has, in its order and at its time, read ahead by a thread into a bounded queue."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from bridge.recording.bag import BadBag, Bag
from bridge.recording.mcap_records import ChannelRecord, Message
from macs_zenoh.errors import MacsError

log = logging.getLogger("macs.replay")

AHEAD = 512
"""Messages that are read ahead."""
AHEAD_BYTES = 8 << 20
"""And no more than that of them."""
LOOP_PAUSE_S = 0.1
"""Between the last message and the first, when a recording is played again."""


class Due(NamedTuple):
    """A message and when it is due, in s after the beginning."""

    at_s: float
    message: Message


class Timeline:
    """Reads one recording. ``wanted`` are the channels to play; ``start_s`` is where to begin in it, ``rate`` how fast
    it is played; ``loop``: again and again.

    Iterate over it in one thread; it ends with the recording, or after `close`. Raises BadBag there.
    """

    def __init__(
        self,
        path: Path,
        wanted: Callable[[ChannelRecord], bool],
        *,
        start_s: float = 0.0,
        rate: float = 1.0,
        loop: bool = False,
    ) -> None:
        self._path = path
        self._wanted = wanted
        self._start_s = start_s
        self._rate = rate
        self._loop = loop
        self._queue: queue.Queue[Due | None] = queue.Queue(AHEAD)
        self._room = threading.Condition()
        self._bytes = 0
        self._closed = False
        self._error: MacsError | None = None
        self._thread = threading.Thread(target=self._read, name="macs-read-ahead", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Read no more."""
        with self._room:
            self._closed = True
            self._room.notify_all()
        while self._thread.is_alive():
            try:
                self._queue.get_nowait()
            except queue.Empty:
                self._thread.join(0.01)
        with suppress(queue.Full):  # who waits for a message waits no longer
            self._queue.put_nowait(None)

    def __iter__(self) -> Iterator[Due]:
        while not self._closed:
            due = self._queue.get()
            if due is None:
                if self._error is not None:
                    raise self._error
                return
            with self._room:
                self._bytes -= len(due.message.data)
                self._room.notify_all()
            yield due

    def _read(self) -> None:
        try:
            with Bag(self._path, cache_bytes=AHEAD_BYTES) as bag:
                start_ns = bag.start_ns + int(self._start_s * 1e9)
                length_s = max(0.0, (bag.end_ns - start_ns) / 1e9) / self._rate + LOOP_PAUSE_S
                turn = 0
                while not self._closed:
                    empty = True
                    for message in bag.messages(self._wanted, start_ns=start_ns):
                        empty = False
                        at_s = (message.log_ns - start_ns) / 1e9 / self._rate + turn * length_s
                        if not self._put(Due(at_s, message)):
                            return
                    turn += 1
                    if empty or not self._loop:
                        return
        except MacsError as error:
            self._error = error
        except Exception as error:  # a file that is damaged in a way nobody has thought of
            log.exception("reading a recording failed")
            self._error = BadBag(self._path, f"cannot be read: {error}")
        finally:
            if not self._closed:
                self._queue.put(None)

    def _put(self, due: Due) -> bool:
        with self._room:
            while self._bytes > AHEAD_BYTES and not self._closed:
                self._room.wait()
            if self._closed:
                return False
            self._bytes += len(due.message.data)
        self._queue.put(due)
        return True
