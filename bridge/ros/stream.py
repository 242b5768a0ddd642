"""Topic data as bytes: CDR into frames, and what can be said of CDR without decoding it. Pure."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterable

from macs_zenoh.protocol.messages import ROS, Metadata, StreamData, encode_management
from macs_zenoh.protocol.wire import MACS, Layout, encode_frame, encode_message

_U32 = struct.Struct("<I")


class StreamFraming:
    """Puts topic data into frames: one concatenation per message, as only two sizes ever change.

    ``registrants`` are (agent type, agent id). Made anew when the registrants change. Called in any thread: with a
    rate limit the intake's and ROS's frame messages of one topic, so size and bytes are replaced together.
    """

    def __init__(self, metadata: Metadata, registrants: Iterable[tuple[int, int]], layout: Layout = MACS) -> None:
        receivers: dict[str, list[int]] = {}
        for agent_type, agent_id in sorted(registrants):
            receivers.setdefault(str(agent_type), []).append(agent_id)
        frame = encode_frame(
            ROS,
            management=encode_management(StreamData(receivers)),
            message=encode_message(metadata.encode()),
            layout=layout,
        )
        self._empty = frame
        self._message_size_at = layout.header_bytes - 4
        self._empty_message_bytes = _U32.unpack_from(frame, self._message_size_at)[0]
        self._sized = (0, frame)
        """Size of the last message, and what stands in front of one of that size."""

    def __call__(self, cdr: bytes) -> bytes:
        cdr_bytes, prefix = self._sized
        if len(cdr) != cdr_bytes:
            prefix = self._resized(len(cdr))
        return prefix + cdr

    def _resized(self, cdr_bytes: int) -> bytes:
        prefix = bytearray(self._empty)
        _U32.pack_into(prefix, self._message_size_at, self._empty_message_bytes + cdr_bytes)
        _U32.pack_into(prefix, len(prefix) - 4, cdr_bytes)
        self._sized = (cdr_bytes, bytes(prefix))
        return self._sized[1]


class Fanout:
    """One message to its receivers: one frame, or two when existing headsets among them read it in another form.

    Made anew when the registrants change, and then only read: by several threads.
    """

    def __init__(
        self,
        metadata: Metadata,
        receivers: Iterable[tuple[int, int]],
        unity: Collection[tuple[int, int]] = (),
        layout: Layout = MACS,
        *,
        translate: Callable[[bytes], bytes] | None = None,
    ) -> None:
        """``unity`` are those that read what ``translate`` makes of a message, if there is such a thing."""
        self._metadata = metadata
        self._unity = unity
        self._layout = layout
        self._translate = translate
        self.receivers = frozenset(receivers)
        others = self.receivers if translate is None else self.receivers - set(unity)
        translated = self.receivers - others
        self._frame = StreamFraming(metadata, others, layout) if others or not translated else None
        self._translated = StreamFraming(metadata, translated, layout) if translated else None

    def __call__(self, cdr: bytes) -> Iterable[bytes]:
        """The frames of a message."""
        if self._translated is None or self._translate is None:
            return (self._frame(cdr),) if self._frame is not None else ()
        translated = self._translated(self._translate(cdr))
        return (translated,) if self._frame is None else (self._frame(cdr), translated)

    def only(self, receivers: Iterable[tuple[int, int]]) -> Fanout:
        """To these alone."""
        return Fanout(self._metadata, receivers, self._unity, self._layout, translate=self._translate)


ENCAPSULATIONS = frozenset((b"\x00\x00", b"\x00\x01"))
"""Plain CDR, big and little endian: what ROS 2 writes and reads (DDS-XTypes 1.3, table 59)."""


def cdr_problem(data: bytes, least_bytes: int = 4) -> str | None:
    """Why these bytes cannot be CDR of a type that needs ``least_bytes``; None when they may be."""
    if not data:
        return "it is empty"
    if len(data) < 4 or data[:2] not in ENCAPSULATIONS:
        # a headset built without its ROS2 define sends ROS 1 serialization: the same without the 4 bytes in front
        return "it does not begin with a CDR header (00 01 00 00), is the sender built for ROS 2?"
    if len(data) < least_bytes:
        return f"it is cut off, at least {least_bytes} bytes are needed"
    return None
