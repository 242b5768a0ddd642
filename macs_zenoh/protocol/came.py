"""How much of what another puts has come, beside what it says that it has put: Zenoh drops, and tells nobody. Pure."""

from __future__ import annotations

import threading
from collections import OrderedDict

from .messages import decode_data
from .robot_state import CommandCount, StreamCount


class Came:
    """Of what one puts with one key.

    Attributes:
        samples: that have come; whoever takes them counts them.
        lost: of what was put since it was told for the first time.
        since: when the other's counting began, by its own clock; None while it has told nothing.
        before: how much it had put by then that did not count here.
    """

    __slots__ = ("before", "lost", "samples", "since")

    def __init__(self) -> None:
        self.samples = 0
        self.lost = 0
        self.since: int | None = None
        self.before = 0

    def count(self, told: StreamCount) -> int:
        """It was told, behind all that it counts: how much more is known to be lost. What is told first says where
        the other's counting and ours begin."""
        ahead = told.put - self.samples - self.lost
        if told.since != self.since:
            self.since, self.before = told.since, ahead
        more = max(0, ahead - self.before)
        self.lost += more
        return more


class CommandsCame:
    """Which commands have come to a robot by its id, of each sender. From any thread."""

    SENDERS = 4096
    """So many are remembered; who sent last is at the end."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of: OrderedDict[str, Came] = OrderedDict()

    def has_come(self, key: str) -> None:
        """Something that was put as commands are, whatever becomes of it."""
        with self._lock:
            came = self._of.get(key)
            if came is None:
                came = self._of[key] = Came()
                if len(self._of) > self.SENDERS:
                    self._of.popitem(last=False)
            else:
                self._of.move_to_end(key)
            came.samples += 1

    def told(self, key: str, data: bytes) -> int:
        """What has come just now was no command, but says behind them how many were put: how many more are missing.
        Raises WireError."""
        with self._lock:
            came = self._of.get(key)
            if came is None:
                return 0
            came.samples -= 1
            return came.count(decode_data(CommandCount, data))
