"""Times at which something has to be looked at, in a thread that does nothing else.

A dead-man must not wait for an event loop that reads what others send.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from collections.abc import Callable

log = logging.getLogger("macs.ros")


class Alarm:
    """One time; `cancel` it when it is not needed any more."""

    __slots__ = ("call",)

    def __init__(self, call: Callable[[], None]) -> None:
        self.call: Callable[[], None] | None = call

    def cancel(self) -> None:
        """It may be under way already."""
        self.call = None


class Alarms:
    """Calls back at times of the monotonic clock. From any thread. The thread begins with the first and ends with
    `close`."""

    def __init__(self) -> None:
        self._waiting: list[tuple[float, int, Alarm]] = []
        self._numbers = itertools.count()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._open = True

    def at(self, when: float, call: Callable[[], None]) -> Alarm:
        """Call back at this time, or at once when it has passed. The callback should be quick."""
        alarm = Alarm(call)
        with self._changed:
            heapq.heappush(self._waiting, (when, next(self._numbers), alarm))
            if self._thread is None and self._open:
                self._thread = threading.Thread(target=self._run, name="macs-alarms", daemon=True)
                self._thread.start()
            elif self._waiting[0][2] is alarm:
                self._changed.notify()
        return alarm

    def close(self) -> None:
        """Call back no more."""
        with self._changed:
            self._open = False
            self._waiting.clear()
            self._changed.notify()

    def _run(self) -> None:
        while (alarm := self._next()) is not None:
            call, alarm.call = alarm.call, None
            if call is None:
                continue
            try:
                call()
            except Exception:
                log.exception("an alarm failed")  # the others are needed all the more

    def _next(self) -> Alarm | None:
        with self._changed:
            while self._open:
                if not self._waiting:
                    self._changed.wait()
                elif (wait_s := self._waiting[0][0] - time.monotonic()) > 0:
                    self._changed.wait(wait_s)
                else:
                    return heapq.heappop(self._waiting)[2]
        return None
