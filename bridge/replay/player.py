"""Plays a timeline: a thread that waits for each message's time and gives it away then.

The loop's own timers are a millisecond coarse, and late when the loop has other work. The thread sleeps to shortly
before a message is due and looks at the clock for the rest.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable

from bridge.recording.mcap_records import Message
from bridge.replay.timeline import Timeline
from macs_zenoh.errors import MacsError

log = logging.getLogger("macs.replay")

SPIN_S = 0.0002
"""So long before a message is due the thread stays awake: to wake up takes about half of that."""
REMEMBERED = 100_000
"""Of so many messages it is known how late they were."""


class Player:
    """``play(message)`` is called in the thread for each message; ``on_end(error)`` when there are no more, or one
    cannot be read or played. What is more than ``max_late_s`` late is left out, as after a program was stopped and
    continued."""

    def __init__(
        self,
        timeline: Timeline,
        play: Callable[[Message], None],
        on_end: Callable[[MacsError | None], None],
        max_late_s: float = math.inf,
    ) -> None:
        self.played = 0
        self.left_out = 0
        self.late_s: list[float] = []
        """How late messages were, the last ones."""
        self._timeline = timeline
        self._play = play
        self._on_end = on_end
        self._max_late_s = max_late_s
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="macs-player", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._timeline.start()
        self._thread.start()

    def stop(self) -> None:
        """Play no more. Waits for the thread."""
        self._stopping.set()
        self._timeline.close()
        if self._thread.ident is not None:
            self._thread.join()

    def late(self, share: float) -> float:
        """How late at most so large a share of the messages was, in s: 0.99 for the 99th of a hundred."""
        ordered = sorted(self.late_s)
        return ordered[min(len(ordered) - 1, int(len(ordered) * share))] if ordered else 0.0

    def _run(self) -> None:
        error: MacsError | None = None
        began = None
        try:
            for due in self._timeline:
                if began is None:  # the first chunk took its time to be read
                    began = time.monotonic() - due.at_s
                if not self._wait(began + due.at_s):
                    return
                late_s = time.monotonic() - began - due.at_s
                if late_s > self._max_late_s:
                    self.left_out += 1
                    continue
                self._play(due.message)
                self.played += 1
                if len(self.late_s) >= REMEMBERED:
                    del self.late_s[: REMEMBERED // 2]
                self.late_s.append(late_s)
        except MacsError as problem:
            error = problem
        except (
            Exception
        ) as problem:  # of whatever takes messages: a recording that stops half way must not look played
            log.exception("a message could not be played")
            error = MacsError(f"a message cannot be played: {problem}")
        finally:
            if not self._stopping.is_set():
                self._on_end(error)

    def _wait(self, until: float) -> bool:
        """Wait for a time; whether to go on."""
        while (left_s := until - time.monotonic()) > 0:
            if left_s > 0.1:
                if self._stopping.wait(min(left_s - 0.05, 1.0)):
                    return False
            elif left_s > SPIN_S:
                time.sleep(left_s - SPIN_S)
        return not self._stopping.is_set()
