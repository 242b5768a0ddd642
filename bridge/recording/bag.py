"""Reads an MCAP file of anybody's, from its index, in the order of time and with bounded memory.

Of 10 GB the index is read and a few chunks are in memory. What a file says of itself is believed only as far as its
own size allows.
"""

from __future__ import annotations

import heapq
import os
import stat
import struct
from array import array
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from bridge.recording.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    FOOTER,
    HEAD,
    HEADER,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    ChannelRecord,
    ChunkRecord,
    Fields,
    Message,
    SchemaRecord,
    channel_record,
    chunk_record,
    message_in,
    read_chunk,
    records_in,
    schema_record,
)
from macs_zenoh.errors import ConfigError, MacsError

MAGIC = b"\x89MCAP0\r\n"
FOOTER_BYTES = 9 + 20
CACHE_BYTES = 24 << 20
"""Chunks that are kept in memory, beside the one that is read."""
MAX_SUMMARY_BYTES = 1 << 30
MAX_RECORD_BYTES = 1 << 30


class BadBag(MacsError):
    """A file cannot be read as a recording. ``problem`` says why, and what to do."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.problem = problem


class Unfinished(BadBag):
    """A file without its index: whoever wrote it was killed, or still writes."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(path, f"it has no index ({why}); if nobody writes it any more: macs bag repair {path}")


def opened(path: Path) -> BinaryIO:
    """A file to read. Raises ConfigError: there is none, or something for which one might wait for ever."""
    try:
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))  # noqa: SIM115
    except OSError as error:
        raise ConfigError(str(path), error.strerror or str(error)) from error
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ConfigError(str(path), "is no file")
    return file


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
        self._file = opened(self.path)
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
                self.chunks.append(chunk_record(data))
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
        self.counts = dict(fields.numbers())

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
            try:
                message = message_in(raw, at, length)
            except ValueError as error:
                raise BadBag(self.path, f"in chunk {number}: {error}") from error
            yield message

    def _entries(self, number: int, ids: set[int], start_ns: int, end_ns: int) -> array[int]:
        """Time, offset and length of each message wanted in a chunk, latest first."""
        raw = self._raw(number)
        found: list[tuple[int, int, int]] = []
        try:
            for opcode, at, length in records_in(raw):
                if opcode != MESSAGE:
                    continue
                channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(raw, at)
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
                opcode, length = HEAD.unpack(self._read(at, 9))
                if opcode == MESSAGE:
                    message = message_in(self._record(at)[1], 0, length)
                    if message.channel in ids and start_ns <= message.log_ns < end_ns:
                        yield message
                at += 9 + length
        except (ValueError, struct.error) as error:
            raise BadBag(self.path, f"at {at}: {error}") from error

    def _record(self, at: int) -> tuple[int, bytes]:
        """Opcode and content of the record there. Raises ValueError."""
        head = self._read(at, 9) if at < self.size else b""
        if len(head) < 9:
            raise ValueError("a record is cut off")
        opcode, length = HEAD.unpack(head)
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
