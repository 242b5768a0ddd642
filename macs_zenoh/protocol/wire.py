"""The MACS wire: header, frame and message, bytes to values and back. No I/O, no clock, no JSON.

A *frame* travels from an agent into the mesh and is the payload of every sample::

    offset  size  field
    0       1     agent type: 0 broadcast, 1 ROS robots, 2 Unity headsets
    1       20    10 x u16 destination ids, 0 = empty slot
    21      10    10 x u8 destination groups, 0 = empty slot
    31      4     u32 M, size of the management data
    35      4     u32 T, size of the message
    39      M     management data, JSON
    39+M    T     the message

A *message* travels from the router to an agent: ``u32 S, S bytes metadata JSON, u32 D, D bytes data``,
with T = 8 + S + D. All integers are unsigned, little-endian, unaligned.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..errors import BadSizes, OutOfRange, TooLong, TooManyDestinations
from .limits import MANAGEMENT_BYTES, METADATA_BYTES, SAMPLE_BYTES

MAX_FRAME_BYTES = 32 << 20
"""Default limit of a whole frame; camera frames of 20 MiB pass."""

MESSAGE_OVERHEAD = 8
"""Bytes of a message that are neither metadata nor data."""

EMPTY_MESSAGE = bytes(MESSAGE_OVERHEAD)
"""What configuration replies and heartbeats carry: no metadata, no data."""

COPY_BYTES = 4096
"""Below this, copying a part of a frame costs less than making a view of it."""

U32 = struct.Struct("<I")
SIZES = struct.Struct("<II")
U32_MAX = 0xFFFFFFFF

Buffer = bytes | bytearray | memoryview


class Header(NamedTuple):
    """A decoded routing header. Empty slots are left out; order and duplicates are kept."""

    agent_type: int
    ids: tuple[int, ...]
    groups: tuple[int, ...]
    management_bytes: int
    message_bytes: int


@dataclass(frozen=True)
class Layout:
    """How many destination slots the header has. One mesh uses one layout; 10 and 10 make the 39 bytes of MACS."""

    id_slots: int = 10
    group_slots: int = 10
    destination_bytes: int = field(init=False, repr=False, compare=False)
    header_bytes: int = field(init=False, repr=False, compare=False)
    _struct: struct.Struct = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 1 <= self.id_slots <= 255:
            raise OutOfRange("id_slots", self.id_slots, 1, 255)
        if not 1 <= self.group_slots <= 255:
            raise OutOfRange("group_slots", self.group_slots, 1, 255)
        packed = struct.Struct(f"<B{self.id_slots}H{self.group_slots}BII")
        object.__setattr__(self, "_struct", packed)
        object.__setattr__(self, "header_bytes", packed.size)
        object.__setattr__(self, "destination_bytes", packed.size - SIZES.size)

    def pack(
        self,
        agent_type: int,
        ids: tuple[int, ...] | list[int] = (),
        groups: tuple[int, ...] | list[int] = (),
        management_bytes: int = 0,
        message_bytes: int = 0,
    ) -> bytes:
        """Encode a header of ``header_bytes`` bytes.

        Raises TooManyDestinations when there are more ids or groups than slots, OutOfRange when a number
        does not fit its field.
        """
        self._check(agent_type, ids, groups)
        for name, size in (("management_bytes", management_bytes), ("message_bytes", message_bytes)):
            if not 0 <= size <= U32_MAX:
                raise OutOfRange(name, size, 0, U32_MAX)
        id_padding = (0,) * (self.id_slots - len(ids))
        group_padding = (0,) * (self.group_slots - len(groups))
        return self._struct.pack(
            agent_type, *ids, *id_padding, *groups, *group_padding, management_bytes, message_bytes
        )

    def unpack(self, buffer: Buffer, at: int = 0) -> Header:
        """Decode the header that starts at offset ``at``. Raises BadSizes when the buffer ends before it does."""
        if len(buffer) - at < self.header_bytes:
            raise BadSizes("header", self.header_bytes, max(0, len(buffer) - at))
        fields = self._struct.unpack_from(buffer, at)
        groups_at = 1 + self.id_slots
        return Header(
            fields[0],
            tuple(i for i in fields[1:groups_at] if i),
            tuple(g for g in fields[groups_at:-2] if g),
            fields[-2],
            fields[-1],
        )

    def _check(self, agent_type: int, ids: tuple[int, ...] | list[int], groups: tuple[int, ...] | list[int]) -> None:
        if not 0 <= agent_type <= 255:
            raise OutOfRange("agent_type", agent_type, 0, 255)
        if len(ids) > self.id_slots:
            raise TooManyDestinations("ids", len(ids), self.id_slots)
        if len(groups) > self.group_slots:
            raise TooManyDestinations("groups", len(groups), self.group_slots)
        for agent_id in ids:
            if not 0 <= agent_id <= 0xFFFF:
                raise OutOfRange("agent id", agent_id, 0, 0xFFFF)
        for group in groups:
            if not 0 <= group <= 255:
                raise OutOfRange("group", group, 0, 255)


MACS = Layout()
"""The layout of every existing MACS program: 39 bytes."""


PROBE = b"macs_check"
"""A payload that begins like this and is shorter than a header only shows that it came through: it asks for nothing,
and whoever gets it passes it to nobody."""


class _Alike:
    """What is the same in all frames of a run, and what a single frame says of it: all before the data."""

    __slots__ = ("_body_at", "_message_at", "data", "layout")

    def __init__(self, data: bytes | bytearray, layout: Layout, message_at: int, body_at: int) -> None:
        """``message_at`` and ``body_at`` are where message and data begin in a (or the first) frame. Only who has
        checked all sizes can know them: `parse_frame`, `parse_frames`, `parse_runs` and `FrameDecoder`."""
        self.data = data
        self.layout = layout
        self._message_at = message_at
        self._body_at = body_at

    @property
    def header(self) -> Header:
        """The decoded header."""
        return self.layout.unpack(self.data)

    @property
    def destination(self) -> bytes:
        """The header without its sizes: equal for frames that go the same way, so it can key a table."""
        return bytes(self.data[: self.layout.destination_bytes])

    @property
    def metadata(self) -> bytes:
        """The metadata JSON of the message."""
        return bytes(self.data[self._message_at + 4 : self._body_at - 4])


class Frame(_Alike):
    """One whole frame whose sizes add up, decoded only as far as asked.

    ``data`` is the bytes as they came; nothing here copies them except `management`, `metadata`, `destination` and
    small messages.
    """

    __slots__ = ()

    count = 1
    """How many frames this is, as of a `Run`."""

    @property
    def has_management(self) -> bool:
        """Whether the frame carries management data (then ids and groups in its header are ignored)."""
        return self._message_at != self.layout.header_bytes

    @property
    def management(self) -> bytes:
        """The management data, possibly empty."""
        return bytes(self.data[self.layout.header_bytes : self._message_at])

    @property
    def message(self) -> bytes | memoryview:
        """The message part: what a TCP agent receives. A copy when that is cheaper than a view."""
        data = self.data
        if type(data) is bytes and len(data) <= COPY_BYTES:
            return data[self._message_at :]
        return memoryview(data)[self._message_at :]

    @property
    def messages(self) -> Sequence[Buffer]:
        """The message alone, as of a `Run`."""
        return (self.message,)

    @property
    def beginning(self) -> bytes:
        """All before the data, with every size: a payload as long that begins like this differs in its data only."""
        return bytes(self.data[: self._body_at])

    @property
    def message_at(self) -> int:
        """Where the message begins."""
        return self._message_at

    @property
    def body(self) -> memoryview:
        """The data part of the message."""
        return memoryview(self.data)[self._body_at :]

    def carries(self, beginning: bytes, least: int = 0) -> bool:
        """Whether the data begins like this and goes on, and is of at least so many bytes."""
        size, at = len(self.data), self._body_at
        return size - at > len(beginning) and size - at >= least and self.data.startswith(beginning, at)

    def each(self) -> Sequence[Frame]:
        """The frame itself, as of a `Run`."""
        return (self,)

    @property
    def last(self) -> Frame:
        """Likewise."""
        return self

    def with_metadata(self, metadata: bytes) -> Frame:
        """The same with other metadata. Raises TooLong."""
        header = self.header
        return parse_frame(
            encode_frame(
                header.agent_type,
                header.ids,
                header.groups,
                management=self.management,
                message=encode_message(metadata, self.body),
                layout=self.layout,
            ),
            self.layout,
        )


class Run(_Alike):
    """Frames one after the other that have everything but their data in common, which is how a burst of one topic's
    messages looks, and which cost little more than one frame. They have no management data.

    ``data`` is the bytes of all of them.
    """

    __slots__ = ("_size", "count")

    has_management = False
    management = b""

    def __init__(self, data: bytes | bytearray, layout: Layout, message_at: int, body_at: int, size: int) -> None:
        """``size`` is that of each frame."""
        super().__init__(data, layout, message_at, body_at)
        self._size = size
        self.count = len(data) // size
        """How many frames there are."""

    @property
    def messages(self) -> Sequence[Buffer]:
        """The message of each frame, in order."""
        data, size, at = self.data, self._size, self._message_at
        return [data[start + at : start + size] for start in range(0, len(data), size)]

    def each(self) -> Sequence[Frame]:
        """The frames, in order."""
        data, size = self.data, self._size
        layout, message_at, body_at = self.layout, self._message_at, self._body_at
        return [Frame(data[start : start + size], layout, message_at, body_at) for start in range(0, len(data), size)]

    @property
    def last(self) -> Frame:
        """The last of the frames."""
        return Frame(self.data[-self._size :], self.layout, self._message_at, self._body_at)

    def with_metadata(self, metadata: bytes) -> Run:
        """The same with other metadata in each. Raises TooLong. What begins them is made once."""
        old, size, at = self.data, self._size, self._body_at
        first = Frame(old[:size], self.layout, self._message_at, at).with_metadata(metadata)
        pieces: list[bytes | bytearray] = [first.beginning, b""] * self.count
        pieces[1::2] = [old[start + at : start + size] for start in range(0, len(old), size)]
        data = b"".join(pieces)
        return Run(data, self.layout, first.message_at, len(first.beginning), len(first.data))


Frames = Frame | Run
"""One frame, or several that begin alike."""


def is_probe(data: Buffer, layout: Layout = MACS) -> bool:
    """Whether a payload is a `PROBE`."""
    return len(data) < layout.header_bytes and bytes(data[: len(PROBE)]) == PROBE


def parse_frame(data: bytes | bytearray, layout: Layout = MACS) -> Frame:
    """Take ``data`` as exactly one frame, check all of its sizes and return it. Raises BadSizes, TooLong."""
    if len(data) < layout.header_bytes:
        raise BadSizes("header", layout.header_bytes, len(data))
    management_bytes, message_bytes = SIZES.unpack_from(data, layout.destination_bytes)
    message_at = layout.header_bytes + management_bytes
    declared = message_at + message_bytes
    if declared != len(data):
        raise BadSizes("frame", declared, len(data))
    if management_bytes > MANAGEMENT_BYTES:
        raise TooLong("management data", management_bytes, MANAGEMENT_BYTES)
    return Frame(data, layout, message_at, data_at(data, message_at, declared))


def parse_frames(data: bytes | bytearray, layout: Layout = MACS) -> list[Frame]:
    """Take ``data`` as one or more whole frames back to back, check all of their sizes and return them.

    That is what a sample on the mesh carries: frames that one sender sent the same way at once. A probe (`PROBE`)
    carries none. Raises BadSizes, TooLong.
    """
    return _parse(data, layout, alike=False)


def parse_runs(data: bytes | bytearray, layout: Layout = MACS) -> list[Frames]:
    """The frames of a sample as `parse_frames`, those that begin alike as one run. Raises BadSizes, TooLong."""
    return _parse(data, layout, alike=True)


def _parse(data: bytes | bytearray, layout: Layout, *, alike: bool) -> list[Any]:
    frames: list[Frames] = []
    start, end = 0, len(data)
    header_bytes, sizes_at = layout.header_bytes, layout.destination_bytes
    while True:
        if end - start < header_bytes:
            if start == 0 and is_probe(data, layout):
                return frames
            raise BadSizes("header", header_bytes, end - start)
        management_bytes, message_bytes = SIZES.unpack_from(data, start + sizes_at)
        message_at = header_bytes + management_bytes
        size = message_at + message_bytes
        stop = start + size
        if stop > end:
            raise BadSizes("frame", size, end - start)
        if management_bytes > MANAGEMENT_BYTES:
            raise TooLong("management data", management_bytes, MANAGEMENT_BYTES)
        if stop != end > SAMPLE_BYTES:
            raise TooLong("a sample of several frames", end, SAMPLE_BYTES)
        body_at = data_at(data, start + message_at, stop)
        if alike and stop != end and not management_bytes:
            stop = run_end(data, start, body_at, size, end)
        piece = data[start:stop] if start or stop != end else data
        if stop - start == size:
            frames.append(Frame(piece, layout, message_at, body_at - start))
        else:
            frames.append(Run(piece, layout, message_at, body_at - start, size))
        if stop == end:
            return frames
        start = stop


def run_end(data: bytes | bytearray, start: int, body_at: int, size: int, end: int) -> int:
    """Where the frames end that begin like the one at ``start``, up to its data at ``body_at``."""
    beginning = data[start:body_at]
    at = start + size
    while at + size <= end and data.startswith(beginning, at):
        at += size
    return at


def encode_frame(
    agent_type: int = 0,
    ids: tuple[int, ...] | list[int] = (),
    groups: tuple[int, ...] | list[int] = (),
    *,
    management: bytes = b"",
    message: Buffer = EMPTY_MESSAGE,
    layout: Layout = MACS,
) -> bytes:
    """Build a whole frame. Raises TooManyDestinations or OutOfRange."""
    header = layout.pack(agent_type, ids, groups, len(management), len(message))
    return b"".join((header, management, message))


def encode_message(metadata: bytes, data: Buffer = b"") -> bytes:
    """Build a message from its metadata JSON and its data."""
    return b"".join((U32.pack(len(metadata)), metadata, U32.pack(len(data)), data))


def split_message(message: Buffer, max_metadata_bytes: int = METADATA_BYTES) -> tuple[bytes, memoryview]:
    """Take a message apart into metadata JSON and data (a view into ``message``). Raises BadSizes, TooLong."""
    at = data_at(message, 0, len(message), max_metadata_bytes)
    view = memoryview(message)
    return bytes(view[4 : at - 4]), view[at:]


def data_at(buffer: Buffer, at: int, size: int, max_metadata_bytes: int = METADATA_BYTES) -> int:
    """Where the data starts of the message from ``at`` to ``size``. Raises BadSizes when its sizes do not add up,
    TooLong when its metadata is more than any needs: such a message must never be forwarded."""
    try:
        metadata_bytes = U32.unpack_from(buffer, at)[0]
        body_at: int = at + MESSAGE_OVERHEAD + metadata_bytes
        if body_at + U32.unpack_from(buffer, body_at - 4)[0] == size:
            if metadata_bytes <= max_metadata_bytes:
                return body_at
            raise TooLong("metadata", metadata_bytes, max_metadata_bytes)
    except struct.error:
        pass
    available = size - at - MESSAGE_OVERHEAD
    if available < 0:
        raise BadSizes("message", MESSAGE_OVERHEAD, available + MESSAGE_OVERHEAD)
    if metadata_bytes > available:
        raise BadSizes("metadata", metadata_bytes, available)
    data_bytes = U32.unpack_from(buffer, body_at - 4)[0]
    raise BadSizes("data", data_bytes, available - metadata_bytes)
