"""A robot's topic data on the mesh: what the robot bridge puts, once for all who are registered."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from contextlib import suppress

from .agent import Agent
from .config import Priority
from .errors import MacsError
from .protocol.keyexpr import STREAM
from .protocol.messages import Metadata, NodeType, StreamData, encode_data, encode_management
from .protocol.robot_state import StreamCount
from .protocol.wire import Layout, encode_frame, encode_message

log = logging.getLogger("macs.streams")

TO_NOBODY = encode_management(StreamData({}))
KNOWN = 4096
"""Names of interface nodes whose keys are remembered."""
FIRST_S, TELL_S = 1.0, 5.0
"""While there is topic data, so often it is told how much there was, to whoever counts what came of it: the first time
soon, later less often; and so long after the last."""
TIMES = 3
"""So often after the last: a link that drops topic data drops counts."""


class _Put:
    """Frames of one node. Who puts one has the lock until it is counted, so that a count is behind no frame that it
    leaves out: a gateway would take it for lost later."""

    __slots__ = ("count", "due", "first", "left", "lock", "since")

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.count = self.left = 0
        self.since = time.monotonic_ns()
        self.first = time.monotonic()
        self.due = self.first + FIRST_S


class Streams:
    """The stream keys of one robot, one for each interface node. Made on the loop; all methods may be called from any
    thread.

    Zenoh drops topic data where a link is full, and tells nobody. So behind what was put goes how much it was, to
    nobody who is registered: gateways know by that how much did not come. It goes in the thread that puts, so that
    nothing comes between the two, or from the loop when nothing is put any more.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._mesh = agent.mesh
        self._keys: dict[str, str] = {}
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._put: dict[str, _Put] = {}
        self._looks = False
        """Whether the loop will look for what was not told."""
        agent.on_id(self._id_changed)

    def publish(self, node: str, frame: bytes) -> None:
        """Put topic data. ``frame`` is a whole frame whose management data lists who gets it (StreamData)."""
        self._publish(node, frame, traced=True)

    def tell(self, node: str, frame: bytes) -> None:
        """Put something beside a node's topic data, which no trace takes for it."""
        self._publish(node, frame, traced=False)

    def _publish(self, node: str, frame: bytes, *, traced: bool) -> None:
        key = self._keys.get(node) or self._key(node)
        put = self._put.get(node) or self._begin(node)
        with put.lock:
            if not self._mesh.streams.put_here(key, frame, traced=traced):
                return
            put.count += 1
            put.left = TIMES
            now = time.monotonic()
            if now >= put.due:
                self._tell(node, put, now)
        with self._lock:
            looks, self._looks = self._looks, True
        if not looks:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._loop.call_later, TELL_S, self._look)

    def prioritise(self, node: str, priority: Priority | None) -> None:
        """Put a node's topic data at this priority; None: at the usual one."""
        self._mesh.prioritise(self._key(node), priority)

    def keep(self, node: str, frames: int | None) -> bool:
        """Keep so many frames of a node's topic data for receivers that miss some; None: as the traffic rules say.
        Returns whether any are kept."""
        return self._mesh.keep(self._key(node), frames)

    def _look(self) -> None:
        """Tell of those that were put last a while ago; the others' threads do so. On the loop."""
        now = time.monotonic()
        with self._lock:
            untold = [(node, put) for node, put in self._put.items() if put.left]
            self._looks = bool(untold)
        try:
            for node, put in untold:
                if now >= put.due and put.lock.acquire(blocking=False):
                    try:
                        put.left -= 1
                        self._tell(node, put, now)
                    finally:
                        put.lock.release()
        except MacsError as error:  # the session is closed
            log.debug("nobody is told how much topic data was put: %s", error)
            return
        if untold:
            self._loop.call_later(TELL_S, self._look)

    def _tell(self, node: str, put: _Put, now: float) -> None:
        """Behind what was put goes how much it was. With its lock held."""
        put.due = now + min(max(now - put.first, FIRST_S), TELL_S)
        settings = self._mesh.settings
        layout = Layout(settings.id_slots, settings.group_slots)
        about = self._agent.type_number, self._agent.id, 0, StreamCount.manager, int(NodeType.SUBSCRIBER), node
        message = encode_message(Metadata(*about).encode(), encode_data(StreamCount(put.since, put.count)))
        frame = encode_frame(self._agent.type_number, management=TO_NOBODY, message=message, layout=layout)
        self._mesh.streams.put_here(self._key(node), frame, ruled=False, traced=False)

    def _begin(self, node: str) -> _Put:
        with self._lock:
            return self._put.setdefault(node, _Put())

    def _key(self, node: str) -> str:
        key = self._keys.get(node)
        if key is None:
            if len(self._keys) >= KNOWN:  # names come from the network
                self._forget()
            key = self._keys[node] = STREAM.of(type=self._agent.type_number, id=self._agent.id, node=node)
        return key

    def _id_changed(self, _old: int, _new: int) -> None:
        self._forget()

    def _forget(self) -> None:
        """Begin anew, also to count."""
        with self._lock:
            self._keys = {}
            self._put.clear()
