"""The number of what a publisher has put last, told after a burst to whoever recovers what was lost.

Zenoh can do the same, but in a task of its own, whose end `AdvancedPublisher.undeclare` waits for while it keeps all
of Python waiting. When Zenoh's threads have come to callbacks of ours then, that never ends, and no signal ends the
program.
"""

from __future__ import annotations

import logging
import threading
from typing import Any

import zenoh

from macs_zenoh.protocol.keyexpr import heartbeat

from .panics import call

log = logging.getLogger("macs.mesh")


class Heartbeat:
    """The sporadic heartbeat of an advanced publisher that counts what it puts. From any thread; until `undeclare`."""

    def __init__(self, session: zenoh.Session, key: str, publisher: Any, after_s: float) -> None:
        own = publisher.id
        self._publisher = session.declare_publisher(
            heartbeat(key, str(own.zid), own.eid), congestion_control=zenoh.CongestionControl.BLOCK
        )
        self._after_s = after_s
        self._lock = threading.Lock()
        self._putting = threading.Lock()
        """Held while it is told, which may take long where a link is full."""
        self._number = 0
        self._timer: threading.Timer | None = None
        self._open = True

    def note(self, number: int) -> None:
        """This number has been put, counted from 0: the last one is told after a while. Never waits."""
        with self._lock:
            self._number = number
            if self._timer is None and self._open:
                self._timer = threading.Timer(self._after_s, self._tell)
                self._timer.daemon = True
                self._timer.start()

    def _tell(self) -> None:
        with self._putting:
            with self._lock:
                self._timer, number = None, self._number
                if not self._open:
                    return
            try:
                call(self._publisher.put, number.to_bytes(4, "little"))
            except zenoh.ZError as error:
                log.debug("heartbeat: %s", error)

    def undeclare(self) -> None:
        """Tell no more. Raises zenoh.ZError, as after the session's end."""
        with self._lock:
            self._open = False
            if self._timer is not None:
                self._timer.cancel()
        with self._putting:
            call(self._publisher.undeclare)
