"""A robot's topic data on the mesh: what the robot bridge puts, once for all who are registered."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import Counter
from contextlib import suppress

from .agent import Agent
from .config import Priority
from .errors import MacsError
from .protocol.keyexpr import STREAM
from .protocol.messages import Metadata, NodeType, StreamData, encode_data, encode_management
from .protocol.robot_state import StreamCount
from .protocol.wire import Layout, encode_frame, encode_message

log = logging.getLogger("macs.streams")

KNOWN = 4096
"""Names of interface nodes whose keys are remembered."""
TELL_S = 5.0
"""So long after topic data it is told how much there was, to whoever counts what came of it."""


class Streams:
    """The stream keys of one robot, one for each interface node. Made on the loop; all methods may be called from any
    thread.

    Zenoh drops topic data where a link is full, and tells nobody. So behind what was put goes how much it was, to
    nobody who is registered: gateways know by that how much did not come.
    """

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._mesh = agent.mesh
        self._keys: dict[str, str] = {}
        self._loop = asyncio.get_running_loop()
        self._lock = threading.Lock()
        self._since = time.monotonic_ns()
        self._put: Counter[str] = Counter()
        """Frames of each node since then."""
        self._untold: set[str] = set()
        agent.on_id(self._id_changed)

    def publish(self, node: str, frame: bytes) -> None:
        """Put topic data. ``frame`` is a whole frame whose management data lists who gets it (StreamData)."""
        if not self._mesh.streams.put_here(self._keys.get(node) or self._key(node), frame):
            return
        with self._lock:
            self._put[node] += 1
            first = not self._untold
            self._untold.add(node)
        if first:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._loop.call_later, TELL_S, self._tell)

    def prioritise(self, node: str, priority: Priority | None) -> None:
        """Put a node's topic data at this priority; None: at the usual one."""
        self._mesh.prioritise(self._key(node), priority)

    def keep(self, node: str, frames: int | None) -> bool:
        """Keep so many frames of a node's topic data for receivers that miss some; None: as the traffic rules say.
        Returns whether any are kept."""
        return self._mesh.keep(self._key(node), frames)

    def _tell(self) -> None:
        """Behind what was put go the counts that have changed. On the loop."""
        with self._lock:
            since, put = self._since, {node: self._put[node] for node in self._untold}
            self._untold.clear()
        settings = self._mesh.settings
        layout = Layout(settings.id_slots, settings.group_slots)
        to_nobody = encode_management(StreamData({}))
        about = self._agent.type_number, self._agent.id, 0, StreamCount.manager, int(NodeType.SUBSCRIBER)
        try:
            for node, count in put.items():
                message = encode_message(Metadata(*about, node).encode(), encode_data(StreamCount(since, count)))
                frame = encode_frame(self._agent.type_number, management=to_nobody, message=message, layout=layout)
                self._mesh.streams.put_here(self._key(node), frame, ruled=False)
        except MacsError as error:  # the session is closed
            log.debug("nobody is told how much topic data was put: %s", error)

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
            self._since = time.monotonic_ns()
            self._put.clear()
            self._untold.clear()
