"""What this program puts, on its way to its own subscriptions: they take it as it is."""

from __future__ import annotations

import logging
import threading
from typing import ClassVar
from weakref import WeakValueDictionary

import zenoh

from .declared import Outlet, Payload
from .panics import end_if_panic

log = logging.getLogger("macs.mesh")


class Loopback:
    """Zenoh calls our own subscriptions back within a put, in the thread that puts. What it would give them is a copy
    of the payload; `own` has the payload itself meanwhile.

    Our own are all subscriptions of the Zenoh session, also those of other meshes over it: they share one (`of`).
    """

    _of: ClassVar[WeakValueDictionary[str, Loopback]] = WeakValueDictionary()
    _of_lock = threading.Lock()

    @classmethod
    def of(cls, zid: str) -> Loopback:
        """That of the Zenoh session with this id."""
        with cls._of_lock:
            return cls._of.setdefault(zid, cls())

    def __init__(self) -> None:
        self.own = threading.local()
        """``payload``: what this thread puts at this moment, None in between. Not set in a thread that never put."""

    def put(self, publisher: Outlet, payload: Payload) -> None:
        """Publish. Zenoh calls our own subscriptions back within this, and they take the payload as it is."""
        self._put(publisher, payload, payload)

    def put_here(self, publisher: Outlet, payload: Payload) -> None:
        """Publish to our own subscriptions only: Zenoh finds them, and is given nothing to copy."""
        self._put(publisher, payload, b"")

    def _put(self, publisher: Outlet, payload: Payload, zenohs: Payload) -> None:
        self.own.payload = payload
        try:
            publisher.put(zenohs)
        except zenoh.ZError as error:  # the session is closed
            log.debug("put: %s", error)
        except BaseException as error:
            end_if_panic(error)
            raise
        finally:
            self.own.payload = None
