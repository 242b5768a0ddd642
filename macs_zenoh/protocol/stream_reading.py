"""What an agent reads of robots' topic data: samples of a stream → the data that is for it. Pure."""

from __future__ import annotations

from collections.abc import Callable

from ..errors import BadField, WireError
from .messages import Metadata, NodeType, StreamData, decode_management
from .wire import Frame, Layout, parse_frames

KNOWN = 512
"""How many beginnings are remembered as already read: of a topic's messages only the data changes."""
KNOWN_BYTES = 4096
"""Longer ones are read each time: what others choose must not decide how much is kept here."""


class StreamReader:
    """Reads the topic data of robots for one agent.

    A robot puts each message once and lists who is registered; some messages are for some of them only, as what a
    topic holds for late ones. ``on_bad(key, error)`` hears of each frame that cannot be used.
    """

    def __init__(self, layout: Layout, on_bad: Callable[[str, WireError], None]) -> None:
        self._layout = layout
        self._on_bad = on_bad
        self._known: dict[tuple[str, tuple[int, int], bytes, bytes], bool] = {}

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
                if self._is_mine(node, me, frame):
                    data.append(bytes(frame.body))
            except WireError as error:
                self._on_bad(key, error)
        return data

    def _is_mine(self, node: str, me: tuple[int, int], frame: Frame) -> bool:
        management, metadata = frame.management, frame.metadata
        known = (node, me, management, metadata)
        mine = self._known.get(known)
        if mine is None:
            mine = _is_for(node, me, management, metadata)
            if len(management) + len(metadata) <= KNOWN_BYTES:
                if len(self._known) >= KNOWN:
                    self._known.clear()
                self._known[known] = mine
        return mine


def _is_for(node: str, me: tuple[int, int], management: bytes, metadata: bytes) -> bool:
    """Whether a message is this node's, and for ``me``. Raises WireError."""
    said = Metadata.decode(metadata)
    if said.node_name != node or said.node_type != NodeType.SUBSCRIBER:
        raise BadField("metadata", f"it is of {said.node_name[:80]!r}, on the key of {node!r}")
    listed = decode_management(management)
    return isinstance(listed, StreamData) and me in listed.targets()
