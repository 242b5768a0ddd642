"""What an agent reads of robots' topic data: samples of a stream → the data that is for it. Pure."""

from __future__ import annotations

from collections.abc import Callable

from ..errors import BadField, WireError
from .messages import Metadata, NodeType, StreamData, decode_management
from .robot_state import StreamCount
from .wire import Frame, Layout, parse_frames

KNOWN = 512
"""How many beginnings are remembered as already read: of a topic's messages only the data changes."""
KNOWN_BYTES = 4096
"""Longer ones are read each time: what others choose must not decide how much is kept here."""


NOT_MINE, DATA, COUNT = range(3)


class StreamReader:
    """Reads the topic data of robots for one agent.

    A robot puts each message once and lists who is registered; some messages are for some of them only, as what a
    topic holds for late ones. ``on_bad(key, error)`` hears of each frame that cannot be used, ``on_count(key, data)``
    of each `StreamCount`.
    """

    def __init__(
        self,
        layout: Layout,
        on_bad: Callable[[str, WireError], None],
        on_count: Callable[[str, bytes], None] = lambda key, data: None,
    ) -> None:
        self._layout = layout
        self._on_bad = on_bad
        self._on_count = on_count
        self._known: dict[tuple[str, tuple[int, int], bytes, bytes], int] = {}

    def read(self, key: str, node: str, payload: bytes | bytearray, me: tuple[int, int]) -> list[bytes]:
        """The data of each message of a sample that lists ``me`` (type, id), of the interface node ``node``."""
        try:
            frames = parse_frames(payload, self._layout)
        except WireError as error:
            self._on_bad(key, error)
            return []
        data: list[bytes] = []
        for frame in frames:
            try:
                what = self._what(node, me, frame)
                if what == DATA:
                    data.append(bytes(frame.body))
                elif what == COUNT:
                    self._on_count(key, bytes(frame.body))
            except WireError as error:
                self._on_bad(key, error)
        return data

    def _what(self, node: str, me: tuple[int, int], frame: Frame) -> int:
        management, metadata = frame.management, frame.metadata
        known = (node, me, management, metadata)
        what = self._known.get(known)
        if what is None:
            what = _read(node, me, management, metadata)
            if len(management) + len(metadata) <= KNOWN_BYTES:
                if len(self._known) >= KNOWN:
                    self._known.clear()
                self._known[known] = what
        return what


def _read(node: str, me: tuple[int, int], management: bytes, metadata: bytes) -> int:
    """Whether a message is for ``me``, and what it is. Raises WireError where it is not this node's."""
    said = Metadata.decode(metadata)
    if said.node_name != node or said.node_type != NodeType.SUBSCRIBER:
        raise BadField("metadata", f"it is of {said.node_name[:80]!r}, on the key of {node!r}")
    listed = decode_management(management)
    if not isinstance(listed, StreamData) or me not in listed.targets():
        return NOT_MINE
    return COUNT if said.message_manager == StreamCount.manager else DATA
