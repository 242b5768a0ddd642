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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from ..errors import BadSizes, FrameTooLarge, OutOfRange, TooLong, TooManyDestinations
from .limits import CONFIGURATION_BYTES, MANAGEMENT_BYTES, METADATA_BYTES, RUN_BYTES, SAMPLE_BYTES

MAX_FRAME_BYTES = 32 << 20
"""Default limit of a whole frame; camera frames of 20 MiB pass."""

MESSAGE_OVERHEAD = 8
"""Bytes of a message that are neither metadata nor data."""

EMPTY_MESSAGE = bytes(MESSAGE_OVERHEAD)
"""What configuration replies and heartbeats carry: no metadata, no data."""

COPY_BYTES = 4096
"""Below this, copying a part of a frame costs less than making a view of it."""

_U32 = struct.Struct("<I")
_SIZES = struct.Struct("<II")
_U32_MAX = 0xFFFFFFFF

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
        object.__setattr__(self, "destination_bytes", packed.size - _SIZES.size)

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
            if not 0 <= size <= _U32_MAX:
                raise OutOfRange(name, size, 0, _U32_MAX)
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


class Frame:
    """One whole frame, decoded only as far as asked; or a *run* of frames that have everything but their data in
    common, which is how a burst of one topic's messages looks, and which costs little more than one frame.

    ``data`` is the bytes as they came; nothing here copies them except `management`, `metadata`, `destination` and
    small messages. What concerns the message is valid after `check`.
    """

    __slots__ = ("_body_at", "_message_at", "_size", "data", "layout")

    def __init__(self, data: bytes | bytearray, layout: Layout, message_at: int, size: int) -> None:
        """``message_at`` is where the message starts: header and management data end there. ``size`` is that of one
        frame; ``data`` is as long, or a multiple of it for a run."""
        self.data = data
        self.layout = layout
        self._message_at = message_at
        self._body_at = 0
        self._size = size

    @property
    def count(self) -> int:
        """How many frames this is."""
        return len(self.data) // self._size

    @property
    def header(self) -> Header:
        """The decoded header."""
        return self.layout.unpack(self.data)

    @property
    def destination(self) -> bytes:
        """The header without its sizes: equal for frames that go the same way, so it can key a table."""
        return bytes(self.data[: self.layout.destination_bytes])

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
        """The message part, of the first frame: what a TCP agent receives. A copy when that is cheaper than a view."""
        data = self.data
        if self._size <= COPY_BYTES and type(data) is bytes:
            return data[self._message_at : self._size]
        return memoryview(data)[self._message_at : self._size]

    @property
    def messages(self) -> Sequence[Buffer]:
        """The message of each frame, in order."""
        data, size, at = self.data, self._size, self._message_at
        if len(data) == size:
            return [self.message]
        return [data[start + at : start + size] for start in range(0, len(data), size)]

    @property
    def metadata(self) -> bytes:
        """The metadata JSON of the message."""
        return bytes(self.data[self._message_at + 4 : self._body_at - 4])

    @property
    def beginning(self) -> bytes:
        """All before the data, with every size: a payload as long that begins like this differs in its data only."""
        return bytes(self.data[: self._body_at])

    @property
    def message_at(self) -> int:
        """Where the message begins, in a frame by itself."""
        return self._message_at

    @property
    def body(self) -> memoryview:
        """The data part of the message, of the first frame."""
        return memoryview(self.data)[self._body_at : self._size]

    def carries(self, beginning: bytes, least: int = 0) -> bool:
        """Whether the data of each frame begins like this and goes on, and is of at least so many bytes."""
        data, size, at = self.data, self._size, self._body_at
        if size - at <= len(beginning) or size - at < least:
            return False
        if len(data) == size:
            return data.startswith(beginning, at)
        return all(data.startswith(beginning, start + at) for start in range(0, len(data), size))

    def check(self) -> None:
        """Raise BadSizes unless the sizes inside the message add up, TooLong when its metadata is more than any needs.
        A frame that fails must never be forwarded."""
        self._body_at = _body_at(self.data, self._message_at, self._size)

    def each(self) -> Iterator[Frame]:
        """The single frames of a run, checked like it."""
        if len(self.data) == self._size:
            yield self
            return
        for start in range(0, len(self.data), self._size):
            yield self.with_data_of(self.data[start : start + self._size])

    def with_data_of(self, data: bytes | bytearray) -> Frame:
        """A frame that is as long and has the same `beginning`; checked like this one."""
        frame = Frame(data, self.layout, self._message_at, self._size)
        frame._body_at = self._body_at
        return frame

    def with_metadata(self, metadata: bytes) -> Frame:
        """The same, checked, with other metadata in each message."""
        header, management = self.header, self.management
        data = b"".join(
            encode_frame(
                header.agent_type,
                header.ids,
                header.groups,
                management=management,
                message=encode_message(metadata, single.body),
                layout=self.layout,
            )
            for single in self.each()
        )
        return parse_frames(data, self.layout, runs=True)[0]


def is_probe(data: Buffer, layout: Layout = MACS) -> bool:
    """Whether a payload is a `PROBE`."""
    return len(data) < layout.header_bytes and bytes(data[: len(PROBE)]) == PROBE


def parse_frame(data: bytes | bytearray, layout: Layout = MACS) -> Frame:
    """Take ``data`` as exactly one frame, check all of its sizes and return it. Raises BadSizes, TooLong."""
    if len(data) < layout.header_bytes:
        raise BadSizes("header", layout.header_bytes, len(data))
    management_bytes, message_bytes = _SIZES.unpack_from(data, layout.destination_bytes)
    declared = layout.header_bytes + management_bytes + message_bytes
    if declared != len(data):
        raise BadSizes("frame", declared, len(data))
    if management_bytes > MANAGEMENT_BYTES:
        raise TooLong("management data", management_bytes, MANAGEMENT_BYTES)
    frame = Frame(data, layout, layout.header_bytes + management_bytes, declared)
    frame.check()
    return frame


def parse_frames(data: bytes | bytearray, layout: Layout = MACS, *, runs: bool = False) -> list[Frame]:
    """Take ``data`` as one or more whole frames back to back, check all of their sizes and return them, with ``runs``
    those that begin alike as one.

    That is what a sample on the mesh carries: frames that one sender sent the same way at once. A probe (`PROBE`)
    carries none. Raises BadSizes, TooLong.
    """
    frames: list[Frame] = []
    start, end = 0, len(data)
    header_bytes, sizes_at = layout.header_bytes, layout.destination_bytes
    while True:
        if end - start < header_bytes:
            if start == 0 and is_probe(data, layout):
                return frames
            raise BadSizes("header", header_bytes, end - start)
        management_bytes, message_bytes = _SIZES.unpack_from(data, start + sizes_at)
        message_at = header_bytes + management_bytes
        size = message_at + message_bytes
        stop = start + size
        if stop > end:
            raise BadSizes("frame", size, end - start)
        if management_bytes > MANAGEMENT_BYTES:
            raise TooLong("management data", management_bytes, MANAGEMENT_BYTES)
        if stop != end > SAMPLE_BYTES:
            raise TooLong("a sample of several frames", end, SAMPLE_BYTES)
        if runs and stop != end and not management_bytes:
            stop = _run_end(data, start, message_at, size, end)
        frame = Frame(data[start:stop] if start or stop != end else data, layout, message_at, size)
        frame.check()
        frames.append(frame)
        if stop == end:
            return frames
        start = stop


def _run_end(data: bytes | bytearray, start: int, message_at: int, size: int, end: int) -> int:
    """Where the frames end that have header, metadata and all sizes of the frame at ``start`` in common."""
    head_bytes = message_at + MESSAGE_OVERHEAD
    if size < head_bytes:
        return start + size
    metadata_bytes = _U32.unpack_from(data, start + message_at)[0]
    head_bytes += metadata_bytes
    if head_bytes > size or metadata_bytes > METADATA_BYTES:
        return start + size  # it will be refused
    head = data[start : start + head_bytes]
    at = start + size
    while at + size <= end and data.startswith(head, at):
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
    return b"".join((_U32.pack(len(metadata)), metadata, _U32.pack(len(data)), data))


def split_message(message: Buffer, max_metadata_bytes: int = METADATA_BYTES) -> tuple[bytes, memoryview]:
    """Take a message apart into metadata JSON and data (a view into ``message``). Raises BadSizes, TooLong."""
    at = _body_at(message, 0, len(message), max_metadata_bytes)
    view = memoryview(message)
    return bytes(view[4 : at - 4]), view[at:]


def _body_at(buffer: Buffer, at: int, size: int, max_metadata_bytes: int = METADATA_BYTES) -> int:
    """Where the data starts of the message from ``at`` to ``size``. Raises BadSizes, TooLong."""
    try:
        metadata_bytes = _U32.unpack_from(buffer, at)[0]
        body_at: int = at + MESSAGE_OVERHEAD + metadata_bytes
        if body_at + _U32.unpack_from(buffer, body_at - 4)[0] == size:
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
    data_bytes = _U32.unpack_from(buffer, body_at - 4)[0]
    raise BadSizes("data", data_bytes, available - metadata_bytes)


class FrameDecoder:
    """Cuts a byte stream, in whatever pieces it comes, into whole frames.

    Two ways in: `feed` takes bytes; `space` and `advance` let a socket receive straight into the decoder, so a big
    frame is copied nowhere. Declared sizes are judged before anything is reserved for them, and memory grows with
    the bytes that really came, never with the bytes that were promised.

    A frame above the limit finishes the decoder, because the next one cannot be found: the frames before it are
    still returned, `error` is set, and whatever follows is ignored.

    A frame whose management data or metadata alone is more than any needs is left out and not stored: its bytes are
    skipped as they come. `refused` has why; who reads it empties it.
    """

    SPACE_BYTES = 256 << 10
    """The most that is received at once."""
    PARTIAL_BYTES = 64 << 10
    """So much is reserved at once for a frame that has begun; then as much again as has come."""

    def __init__(
        self,
        max_frame_bytes: int = MAX_FRAME_BYTES,
        layout: Layout = MACS,
        scratch: bytearray | None = None,
        *,
        runs: bool = False,
    ) -> None:
        """``scratch`` is where `space` receives small frames; decoders that are never filled at the same time
        (connections of one event loop) may share one. ``runs`` gives frames that begin alike as one; it may be
        changed at any time."""
        self.max_frame_bytes = max_frame_bytes
        self.layout = layout
        self.error: FrameTooLarge | None = None
        self.refused: list[TooLong] = []
        self.runs = runs
        self._received = scratch if scratch is not None else bytearray(self.SPACE_BYTES)
        self._scratch = memoryview(self._received)
        self._partial = bytearray()  # a frame that has begun; its length is what is reserved, not what has come
        self._filled = 0
        self._message_at = 0
        self._wanted = 0  # size of the whole partial frame; 0 while its header is incomplete
        self._judged = True  # whether the size of its metadata was looked at
        self._skip = 0  # bytes of a refused frame that are still to come

    @property
    def begun(self) -> int:
        """How much has come of a frame that has begun and is not whole; 0 when there is none."""
        return self._filled or len(self._partial)

    @property
    def begun_header(self) -> bytes:
        """What has come of a header that is not whole."""
        return b"" if self._wanted else bytes(self._partial)

    @property
    def partial_bytes(self) -> int:
        """How much memory a frame that has begun has."""
        return len(self._partial)

    def feed(self, data: bytes | bytearray | memoryview) -> list[Frame]:
        """Take the next bytes of the stream and return the frames that are now whole."""
        frames: list[Frame] = []
        view = memoryview(data)
        while len(view) and not self.error:
            space = self.space()
            size = min(len(space), len(view))
            space[:size] = view[:size]
            del space  # an exported view would keep the partial frame from growing
            frames += self.advance(size)
            view = view[size:]
        return frames

    def space(self) -> memoryview:
        """Where the next bytes of the stream belong. Never empty; give it back before calling `advance`.

        Never large either: an event loop may fill it many times before anything else gets its turn.
        """
        if not self._wanted:
            return self._scratch[: self._skip] if self._skip else self._scratch
        if self._filled == len(self._partial):
            self._partial.extend(bytes(min(self._wanted, 2 * self._filled) - self._filled))
        return memoryview(self._partial)[self._filled : self._filled + self.SPACE_BYTES]

    def advance(self, size: int) -> list[Frame]:
        """``size`` bytes were written to the start of `space`: return the frames that are now whole."""
        if self.error:
            return []
        if self._wanted:
            self._filled += size
            if self._filled == self._wanted:
                return [self._finish()]
            if not self._judged:
                self._judge(memoryview(self._partial)[: self._filled])
            return []
        if self._skip:
            self._skip -= size
            self._filled = self._filled + size if self._skip else 0
            return []
        if self._partial:  # of a header
            begun = self._partial + self._scratch[:size]
            self._partial = bytearray()
            return self._cut(begun, len(begun))
        return self._cut(self._received, size)

    def _cut(self, data: bytearray, end: int) -> list[Frame]:
        """Cut whole frames off ``data`` up to ``end`` and keep the rest as the beginning of the next one. What is kept
        is copied, once."""
        layout = self.layout
        header_bytes = layout.header_bytes
        sizes_at = layout.destination_bytes
        frames: list[Frame] = []
        view = memoryview(data)
        start = 0
        while end - start >= header_bytes:
            management_bytes, message_bytes = _SIZES.unpack_from(data, start + sizes_at)
            message_at = header_bytes + management_bytes
            size = message_at + message_bytes
            if size > self.max_frame_bytes:
                self.error = FrameTooLarge(size, self.max_frame_bytes)
                return frames
            if management_bytes > CONFIGURATION_BYTES:
                self._refuse(TooLong("management data", management_bytes, CONFIGURATION_BYTES), size, end - start)
                start = min(start + size, end)
                continue
            stop = start + size
            if stop > end:
                self._begin(view[start:end], size, message_at)
                return frames
            if self.runs and stop != end and not management_bytes:
                stop = _run_end(data, start, message_at, size, min(end, start + RUN_BYTES))
            frames.append(Frame(bytes(view[start:stop]), layout, message_at, size))
            start = stop
        if start != end:
            self._partial = bytearray(view[start:end])
        return frames

    def _begin(self, data: memoryview, wanted: int, message_at: int) -> None:
        begun = len(data)
        self._partial = bytearray(min(wanted, max(2 * begun, self.PARTIAL_BYTES)))
        self._partial[:begun] = data
        self._filled = begun
        self._message_at = message_at
        self._wanted = wanted
        self._judged = False
        self._judge(data)

    def _judge(self, data: memoryview) -> None:
        """Look at the size of the metadata of the partial frame as soon as it has come."""
        at = self._message_at
        if len(data) < at + 4:
            return
        self._judged = True
        metadata_bytes = _U32.unpack_from(data, at)[0]
        if METADATA_BYTES < metadata_bytes <= self._wanted - at - MESSAGE_OVERHEAD:  # else its sizes do not add up
            self._refuse(TooLong("metadata", metadata_bytes, METADATA_BYTES), self._wanted, len(data))

    def _refuse(self, error: TooLong, size: int, available: int) -> None:
        """Let go of a frame of which so much is there."""
        self.refused.append(error)
        self._skip = max(0, size - available)
        self._filled = available if self._skip else 0
        self._wanted = 0
        self._partial = bytearray()

    def _finish(self) -> Frame:
        frame = Frame(self._partial, self.layout, self._message_at, self._wanted)
        self._partial = bytearray()
        self._filled = self._wanted = 0
        return frame


class Skipped(NamedTuple):
    """A message that was too large: its size, and its metadata."""

    size: int
    metadata: bytes


class MessageDecoder:
    """Cuts the stream that a TCP agent receives into whole messages (they have no header and no outer size).

    With ``skip_large`` a message whose data is too large is let go of unread, for `skipped`; otherwise it is an error.
    """

    def __init__(self, max_message_bytes: int = MAX_FRAME_BYTES, *, skip_large: bool = False) -> None:
        self.max_message_bytes = max_message_bytes
        self.skipped: list[Skipped] = []
        """Messages that were too large; whoever reads takes them out."""
        self._skip_large = skip_large
        self._skip_bytes = 0
        self._buffer = bytearray()

    def feed(self, data: Buffer) -> list[bytes]:
        """Take the next bytes and return the messages that are now whole. Raises FrameTooLarge."""
        if self._skip_bytes:
            data = memoryview(data)
            skipped = min(self._skip_bytes, len(data))
            self._skip_bytes -= skipped
            data = data[skipped:]
        self._buffer += data
        messages = []
        start = 0
        while (size := self._message_size(start)) is not None:
            if size > self.max_message_bytes:
                self.skipped.append(self._metadata_of(start, size))
                self._skip_bytes = max(0, size - (len(self._buffer) - start))
            elif len(self._buffer) - start >= size:
                messages.append(bytes(memoryview(self._buffer)[start : start + size]))
            else:
                break
            start = min(start + size, len(self._buffer))
        del self._buffer[:start]
        return messages

    def _metadata_of(self, at: int, size: int) -> Skipped:
        metadata_bytes: int = _U32.unpack_from(self._buffer, at)[0]
        return Skipped(size, bytes(memoryview(self._buffer)[at + 4 : at + 4 + metadata_bytes]))

    def _message_size(self, at: int) -> int | None:
        """Size of the message at ``at``, None while that is not known yet."""
        available = len(self._buffer) - at
        if available < 4:
            return None
        metadata_bytes: int = _U32.unpack_from(self._buffer, at)[0]
        self._judge(MESSAGE_OVERHEAD + metadata_bytes)
        if available < MESSAGE_OVERHEAD + metadata_bytes:
            return None
        data_bytes: int = _U32.unpack_from(self._buffer, at + 4 + metadata_bytes)[0]
        if not self._skip_large:
            self._judge(MESSAGE_OVERHEAD + metadata_bytes + data_bytes)
        return MESSAGE_OVERHEAD + metadata_bytes + data_bytes

    def _judge(self, size: int) -> None:
        if size > self.max_message_bytes:
            raise FrameTooLarge(size, self.max_message_bytes)
