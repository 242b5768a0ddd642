"""Reads an MCAP file of anybody's, from its index, in the order of time and with bounded memory.

Of 10 GB the index is read and a few chunks are in memory. What a file says of itself is believed only as far as its
own size allows.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, NamedTuple

from macs_zenoh.errors import ConfigError, MacsError

MAGIC = b"\x89MCAP0\r\n"
FOOTER_BYTES = 9 + 20
CACHE_BYTES = 24 << 20
"""Chunks that are kept in memory, beside the one that is read."""
MAX_CHUNK_BYTES = 1 << 30
MAX_SUMMARY_BYTES = 1 << 30
MAX_RECORD_BYTES = 1 << 30

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")


class BadBag(MacsError):
    """A file cannot be read as a recording. ``problem`` says why, and what to do."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.problem = problem


class Unfinished(BadBag):
    """A file without its index: whoever wrote it was killed, or still writes."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(path, f"it has no index ({why}); if nobody writes it any more: macs bag repair {path}")


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

    @property
    def is_empty(self) -> bool:
        """Whether nothing is left."""
        return self._at >= len(self._data)


_U16 = struct.Struct("<H")


def schema_record(data: bytes | memoryview) -> SchemaRecord:
    """Read one. Raises ValueError."""
    fields = Fields(data)
    return SchemaRecord(fields.u16(), fields.text(), fields.text(), fields.take(fields.u32()))


def channel_record(data: bytes | memoryview) -> ChannelRecord:
    """Read one. Raises ValueError."""
    fields = Fields(data)
    return ChannelRecord(fields.u16(), fields.u16(), fields.text(), fields.text(), fields.pairs())


def _chunk_record(data: bytes) -> ChunkRecord:
    fields = Fields(data)
    start_ns, end_ns, offset, length = fields.u64(), fields.u64(), fields.u64(), fields.u64()
    channels = frozenset(channel for channel, _ in struct.iter_unpack("<HQ", fields.take(fields.u32())))
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
        opcode, length = _HEAD.unpack_from(raw, at)
        at += 9
        if at + length > end:
            raise ValueError("a record is cut off")
        yield opcode, at, length
        at += length


def message_in(raw: bytes, at: int, length: int) -> Message:
    """The message whose record's content is there. Raises ValueError."""
    if length < _MESSAGE.size:
        raise ValueError("a message is cut off")
    channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(raw, at)
    return Message(channel, sequence, log_ns, publish_ns, raw[at + _MESSAGE.size : at + length])


class Bag:
    """A finished file, open for reading. Raises Unfinished, BadBag, ConfigError where there is no such file."""

    def __init__(self, path: Path | str, *, cache_bytes: int = CACHE_BYTES) -> None:
        self.path = Path(path)
        self.profile = ""
        self.library = ""
        self.schemas: dict[int, SchemaRecord] = {}
        self.channels: dict[int, ChannelRecord] = {}
        self.chunks: list[ChunkRecord] = []
        self.counts: dict[int, int] = {}
        self.start_ns = self.end_ns = 0
        self.metadata_at: list[tuple[str, int, int]] = []
        self.size = 0
        self.data_end = 0
        """Where the data ends and the index begins."""
        self._cache_bytes = cache_bytes
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        try:
            self._file: BinaryIO = self.path.open("rb")
        except OSError as error:
            raise ConfigError(str(path), error.strerror or str(error)) from error
        try:
            self._open()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        self._cache.clear()

    @property
    def messages_in_all(self) -> int:
        """How many messages there are."""
        return sum(self.counts.values())

    def schema_of(self, channel: ChannelRecord) -> SchemaRecord | None:
        """The schema of a channel, if it has one."""
        return self.schemas.get(channel.schema_id)

    # -- the index -----------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self.size = self._file.seek(0, os.SEEK_END)
        if self._read(0, len(MAGIC)) != MAGIC:
            raise BadBag(self.path, "it is no MCAP file")
        try:
            opcode, header = self._record(len(MAGIC))
            if opcode != HEADER:
                raise ValueError("it does not begin with a header")
            fields = Fields(header)
            self.profile, self.library = fields.text(), fields.text()
        except ValueError as error:
            raise BadBag(self.path, f"it is no MCAP file that can be read: {error}") from error
        end = self.size - len(MAGIC) - FOOTER_BYTES
        if end < len(MAGIC) or self._read(self.size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise Unfinished(self.path, "its end is missing")
        try:
            opcode, footer = self._record(end)
            summary_at = Fields(footer).u64()
            if opcode != FOOTER or summary_at > end:
                raise ValueError("its footer makes no sense")
            if not summary_at:
                raise Unfinished(self.path, "nobody wrote one")
            self._read_summary(summary_at, end)
        except ValueError as error:
            raise Unfinished(self.path, str(error)) from error

    def _read_summary(self, at: int, end: int) -> None:
        if end - at > MAX_SUMMARY_BYTES:
            raise ValueError(f"an index of {end - at} bytes")
        summary = self._read(at, end - at)
        self.data_end = at
        told = False
        for opcode, where, length in records_in(summary):
            data = summary[where : where + length]
            if opcode == SCHEMA:
                schema = schema_record(data)
                self.schemas[schema.id] = schema
            elif opcode == CHANNEL:
                channel = channel_record(data)
                self.channels[channel.id] = channel
            elif opcode == CHUNK_INDEX:
                self.chunks.append(_chunk_record(data))
            elif opcode == STATISTICS:
                told = True
                self._read_statistics(Fields(data))
            elif opcode == METADATA_INDEX:
                fields = Fields(data)
                offset, size = fields.u64(), fields.u64()
                self.metadata_at.append((fields.text(), offset, size))
        if not told:
            raise ValueError("its index has no statistics")

    def _read_statistics(self, fields: Fields) -> None:
        fields.u64()
        fields.u16()
        for _ in range(4):
            fields.u32()
        self.start_ns, self.end_ns = fields.u64(), fields.u64()
        self.counts = dict(struct.iter_unpack("<HQ", fields.take(fields.u32())))

    def metadata(self) -> list[tuple[str, dict[str, str]]]:
        """The file's own names and values. Raises BadBag."""
        found = []
        for _, offset, _ in self.metadata_at:
            try:
                opcode, data = self._record(offset)
                if opcode == METADATA:
                    fields = Fields(data)
                    found.append((fields.text(), fields.pairs()))
            except ValueError as error:
                raise BadBag(self.path, f"metadata at {offset}: {error}") from error
        return found

    # -- messages ------------------------------------------------------------------------------------------------

    def messages(
        self,
        wanted: Callable[[ChannelRecord], bool] = lambda channel: True,
        *,
        start_ns: int = 0,
        end_ns: int = 1 << 63,
    ) -> Iterator[Message]:
        """Messages of the channels wanted, from ``start_ns`` to before ``end_ns``, by log time; those of one time as
        they stand in the file. Raises BadBag."""
        ids = {channel.id for channel in self.channels.values() if wanted(channel)}
        if not self.chunks:
            yield from self._without_chunks(ids, start_ns, end_ns)
            return
        chunks = sorted(
            (
                (chunk.start_ns, number)
                for number, chunk in enumerate(self.chunks)
                if chunk.end_ns >= start_ns
                and chunk.start_ns < end_ns
                and (not chunk.channels or chunk.channels & ids)
            ),
        )
        opened: list[tuple[int, int, int, _Open]] = []
        next_chunk = 0
        while opened or next_chunk < len(chunks):
            while next_chunk < len(chunks) and (not opened or chunks[next_chunk][0] <= opened[0][0]):
                number = chunks[next_chunk][1]
                next_chunk += 1
                entries = _Open(number, self._entries(number, ids, start_ns, end_ns))
                if entries.left:
                    heapq.heappush(opened, (entries.time, number, 0, entries))
            if not opened:
                continue
            _, number, count, entries = opened[0]
            raw, at, length = self._raw(number), *entries.take()
            if entries.left:
                heapq.heapreplace(opened, (entries.time, number, count + 1, entries))
            else:
                heapq.heappop(opened)
                self._forget(number)
            yield message_in(raw, at, length)

    def _entries(self, number: int, ids: set[int], start_ns: int, end_ns: int) -> array[int]:
        """Time, offset and length of each message wanted in a chunk, latest first."""
        raw = self._raw(number)
        found: list[tuple[int, int, int]] = []
        try:
            for opcode, at, length in records_in(raw):
                if opcode != MESSAGE:
                    continue
                channel, _, log_ns, _ = _MESSAGE.unpack_from(raw, at)
                if channel in ids and start_ns <= log_ns < end_ns:
                    found.append((log_ns, at, length))
        except (ValueError, struct.error) as error:
            raise BadBag(self.path, f"chunk {number}: {error}; macs bag repair {self.path} keeps the rest") from error
        found.sort(reverse=True)
        return array("Q", [value for entry in found for value in entry])

    def _raw(self, number: int) -> bytes:
        raw = self._cache.get(number)
        if raw is not None:
            self._cache.move_to_end(number)
            return raw
        chunk = self.chunks[number]
        try:
            opcode, data = self._record(chunk.offset)
            if opcode != CHUNK:
                raise ValueError("there is no chunk where the index says")
            read = read_chunk(data)
            if not read.is_whole:
                raise ValueError("its checksum is wrong")
        except ValueError as error:
            raise BadBag(self.path, f"chunk {number}: {error}; macs bag repair {self.path} keeps the rest") from error
        self._cache[number] = read.raw
        while len(self._cache) > 1 and sum(map(len, self._cache.values())) > self._cache_bytes:
            self._cache.popitem(last=False)
        return read.raw

    def _forget(self, number: int) -> None:
        self._cache.pop(number, None)

    def _without_chunks(self, ids: set[int], start_ns: int, end_ns: int) -> Iterator[Message]:
        """Of a file without chunks, as they stand there."""
        at = len(MAGIC)
        try:
            while at < self.data_end:
                opcode, length = _HEAD.unpack(self._read(at, 9))
                if opcode == MESSAGE:
                    message = message_in(self._record(at)[1], 0, length)
                    if message.channel in ids and start_ns <= message.log_ns < end_ns:
                        yield message
                at += 9 + length
        except (ValueError, struct.error) as error:
            raise BadBag(self.path, f"at {at}: {error}") from error

    def _record(self, at: int) -> tuple[int, bytes]:
        """Opcode and content of the record there. Raises ValueError."""
        head = self._read(at, 9)
        if len(head) < 9:
            raise ValueError("a record is cut off")
        opcode, length = _HEAD.unpack(head)
        if length > MAX_RECORD_BYTES or at + 9 + length > self.size:
            raise ValueError("a record is longer than the file")
        data = self._read(at + 9, length)
        if len(data) < length:
            raise ValueError("a record is cut off")
        return opcode, data

    def _read(self, at: int, size: int) -> bytes:
        try:
            self._file.seek(at)
            return self._file.read(size)
        except OSError as error:
            raise BadBag(self.path, error.strerror or str(error)) from error


class _Open:
    """What is left of a chunk that is being read."""

    __slots__ = ("_entries", "number")

    def __init__(self, number: int, entries: array[int]) -> None:
        self.number = number
        self._entries = entries

    @property
    def left(self) -> bool:
        """Whether there is more."""
        return bool(self._entries)

    @property
    def time(self) -> int:
        """Of the next message."""
        return self._entries[-3]

    def take(self) -> tuple[int, int]:
        """Where the next message is, and how long."""
        at, length = self._entries[-2], self._entries[-1]
        del self._entries[-3:]
        return at, length


def named(bag: Bag, names: Iterable[str], fits: Callable[[str, str], bool]) -> Callable[[ChannelRecord], bool]:
    """Which channels have a name that fits one of these patterns; without any, all."""
    patterns = list(names)
    chosen: Mapping[int, bool] = {
        channel.id: not patterns or any(fits(pattern, channel.topic) for pattern in patterns)
        for channel in bag.channels.values()
    }
    return lambda channel: chosen[channel.id]
