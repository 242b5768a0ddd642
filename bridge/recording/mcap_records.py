"""MCAP's records as values: what stands in a file, byte by byte. Pure.

Nothing that a file declares is believed beyond its size. The library's own records are for writing: to read 10 000 of
them with it takes seconds.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

MAX_CHUNK_BYTES = 1 << 30
"""A larger chunk is not read."""

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

HEAD = struct.Struct("<BQ")
"""Before each record: what it is, and how long."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_PAIR = struct.Struct("<HQ")


class SchemaRecord(NamedTuple):
    """A schema of a file."""

    id: int
    name: str
    encoding: str
    data: bytes


class ChannelRecord(NamedTuple):
    """A channel of a file."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class ChunkRecord(NamedTuple):
    """Where a chunk is."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    channels: frozenset[int]
    """Those that have messages in it; empty where nobody said."""
    compression: str
    size: int
    """Uncompressed."""


class Message(NamedTuple):
    """One message of a file."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes


class Fields:
    """Takes values out of a record, one after the other. Raises ValueError where it ends too early."""

    __slots__ = ("_at", "_data")

    def __init__(self, data: bytes | memoryview) -> None:
        self._data = data
        self._at = 0

    def number(self, form: struct.Struct) -> int:
        """One number."""
        at, self._at = self._at, self._at + form.size
        if self._at > len(self._data):
            raise ValueError("it ends too early")
        return int(form.unpack_from(self._data, at)[0])

    def u16(self) -> int:
        """Two bytes."""
        return self.number(_U16)

    def u32(self) -> int:
        """Four."""
        return self.number(_U32)

    def u64(self) -> int:
        """Eight."""
        return self.number(_U64)

    def take(self, size: int) -> bytes:
        """So many bytes."""
        at, self._at = self._at, self._at + size
        if self._at > len(self._data):
            raise ValueError("it ends too early")
        return bytes(self._data[at : self._at])

    def text(self) -> str:
        """A text with its length before it."""
        return self.take(self.u32()).decode("utf-8", "replace")

    def rest(self) -> bytes:
        """All that is left."""
        return bytes(self._data[self._at :])

    def pairs(self) -> dict[str, str]:
        """Names and values."""
        inner = Fields(self.take(self.u32()))
        found: dict[str, str] = {}
        while not inner.is_empty:
            name = inner.text()
            found[name] = inner.text()
        return found

    def numbers(self) -> list[tuple[int, int]]:
        """Pairs of a number of two bytes and one of eight."""
        data = self.take(self.u32())
        if len(data) % _PAIR.size:
            raise ValueError("a table is cut off")
        return list(_PAIR.iter_unpack(data))

    @property
    def is_empty(self) -> bool:
        """Whether nothing is left."""
        return self._at >= len(self._data)


def schema_record(data: bytes | memoryview) -> SchemaRecord:
    """Read one. Raises ValueError."""
    fields = Fields(data)
    return SchemaRecord(fields.u16(), fields.text(), fields.text(), fields.take(fields.u32()))


def channel_record(data: bytes | memoryview) -> ChannelRecord:
    """Read one. Raises ValueError."""
    fields = Fields(data)
    return ChannelRecord(fields.u16(), fields.u16(), fields.text(), fields.text(), fields.pairs())


def chunk_record(data: bytes) -> ChunkRecord:
    fields = Fields(data)
    start_ns, end_ns, offset, length = fields.u64(), fields.u64(), fields.u64(), fields.u64()
    channels = frozenset(channel for channel, _ in fields.numbers())
    fields.u64()
    compression = fields.text()
    fields.u64()
    return ChunkRecord(start_ns, end_ns, offset, length, channels, compression, fields.u64())


def decompressed(data: bytes, compression: str, size: int) -> bytes:
    """A chunk's messages. Raises ValueError: it is none, or not of that size."""
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {size} bytes, at most {MAX_CHUNK_BYTES} are read")
    if compression == "":
        raw = data
    elif compression == "zstd":
        import zstandard

        try:
            if zstandard.frame_content_size(data) not in (-1, size):  # which would be believed
                raise ValueError("its size is not what it says")
            raw = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from error
    elif compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped, unused-ignore]

        try:
            raw = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        except (RuntimeError, ValueError, EOFError) as error:
            raise ValueError(str(error)) from error
    else:
        raise ValueError(f"compression {compression[:20]!r} is unknown")
    if len(raw) != size:
        raise ValueError(f"a chunk of {len(raw)} bytes says that it has {size}")
    return raw


class Chunk(NamedTuple):
    """A chunk that was read."""

    raw: bytes
    crc: int
    """What it shall be; 0: nobody says."""

    @property
    def is_whole(self) -> bool:
        """Whether its checksum holds."""
        return not self.crc or zlib.crc32(self.raw) == self.crc


def read_chunk(data: bytes) -> Chunk:
    """A chunk record's content. Raises ValueError."""
    fields = Fields(data)
    fields.u64()
    fields.u64()
    size, crc, compression = fields.u64(), fields.u32(), fields.text()
    return Chunk(decompressed(fields.take(fields.u64()), compression, size), crc)


def records_in(raw: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, where its content begins, how long it is) of each record in a chunk. Raises ValueError."""
    at, end = 0, len(raw)
    while at < end:
        if at + 9 > end:
            raise ValueError("a record is cut off")
        opcode, length = HEAD.unpack_from(raw, at)
        at += 9
        if at + length > end:
            raise ValueError("a record is cut off")
        yield opcode, at, length
        at += length


def message_in(raw: bytes, at: int, length: int) -> Message:
    """The message whose record's content is there. Raises ValueError."""
    if length < MESSAGE_HEAD.size:
        raise ValueError("a message is cut off")
    channel, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(raw, at)
    return Message(channel, sequence, log_ns, publish_ns, raw[at + MESSAGE_HEAD.size : at + length])
