"""The number of what a publisher has put last, told after a burst, or again and again, to whoever recovers what was
lost.

Zenoh can do the same, but in a task of its own, whose end `AdvancedPublisher.undeclare` waits for while it keeps all
of Python waiting. When Zenoh's threads have come to callbacks of ours then, that never ends, and no signal ends the
program.
"""

from __future__ import annotations

import logging
import threading
from typing import Any
from weakref import WeakSet

import zenoh

from macs_zenoh.protocol.keyexpr import heartbeat
from macs_zenoh.protocol.recovery import NUMBERS

from .declared import Payload
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
                call(self._publisher.put, _told(number))
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


class Counted:
    """An advanced publisher that counts what it has put, for `Heartbeats`. From any thread."""

    def __init__(self, session: zenoh.Session, key: str, publisher: Any) -> None:
        own = publisher.id
        self._publisher = publisher
        self._heartbeat = session.declare_publisher(heartbeat(key, str(own.zid), own.eid))
        self._lock = threading.Lock()
        self._count = 0

    def put(self, payload: Payload, **mark: Any) -> None:
        """Publish."""
        self._publisher.put(payload, **mark)
        with self._lock:
            self._count += 1

    def tell(self) -> None:
        """Tell the number of the last one, if there is one. Raises zenoh.ZError, as after the session's end."""
        if self._count:
            call(self._heartbeat.put, _told(self._count - 1))


class Heartbeats:
    """Tells the numbers of publishers again and again, by one thread for all of them; of each while somebody else has
    it. Until `close`."""

    def __init__(self, every_s: float) -> None:
        self._every_s = every_s
        self._counted: WeakSet[Counted] = WeakSet()
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def add(self, counted: Counted) -> None:
        """Tell its number as well."""
        with self._lock:
            self._counted.add(counted)
            if self._thread is None and not self._closed.is_set():
                self._thread = threading.Thread(target=self._run, name="macs-heartbeats", daemon=True)
                self._thread.start()

    def _run(self) -> None:
        while not self._closed.wait(self._every_s):
            with self._lock:
                all_of_them = list(self._counted)
            while all_of_them and not self._closed.is_set():
                try:
                    all_of_them.pop().tell()
                except zenoh.ZError as error:
                    log.debug("heartbeat: %s", error)

    def close(self, timeout_s: float) -> None:
        """Tell no more; waits for what is being told, for at most so long."""
        self._closed.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join(timeout_s)


def _told(number: int) -> bytes:
    """A number as Zenoh writes it, which counts in 32 bits."""
    return (number % NUMBERS).to_bytes(4, "little")
