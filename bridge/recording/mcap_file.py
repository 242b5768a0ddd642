"""One MCAP file, written so that a program that is killed loses a moment and no more.

Schemas and channels stand before the chunks that need them, each chunk is one write, and the index comes at the end:
`repair` can make it from what is there. The library's own writer keeps a chunk until it is full, however long that
takes, and takes 20 µs for a message; records other than messages are its records.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from bridge.pieces import small_joined
from bridge.recording import LIBRARY, PROFILE

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 2 << 20
"""A chunk is written when it has so much; replaying needs a few of them in memory."""
REMEMBERED = 256
"""So many chunks can be given up, where the disk has no room for the index."""
COMPRESSIONS = ("zstd", "lz4", "none")
LARGE_BYTES = 64 << 10
"""A message of so much is written from where it is, without a copy in between."""
SAMPLED_BYTES, LEAST_SAMPLE_BYTES = 48 << 10, 4 << 10
"""So much of a chunk is tried first, of each of its pieces the same: what gets no smaller, as pictures that are
compressed or full of noise, is written as it is, for a tenth of the time."""
WORTH = 0.9
"""Of its size a chunk has to have at most so much, as the samples tell: each counts as much as its piece is large."""

Closing = Callable[[], Mapping[str, Mapping[str, str]]]
"""Says at the end what stands in metadata records, by their names."""

_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_BYTES = 22
_CHUNK = struct.Struct("<BQQQQI")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")
_INDEX = struct.Struct("<BQHI")


def compressor(name: str) -> Callable[[bytes], bytes]:
    """What makes a chunk smaller: ``zstd``, ``lz4`` or ``none``."""
    if name == "zstd":
        import zstandard

        small: Callable[[bytes], bytes] = zstandard.ZstdCompressor(level=1).compress
        return small
    if name == "lz4":
        import lz4.frame  # type: ignore[import-untyped, unused-ignore]

        compress: Callable[[bytes], bytes] = lz4.frame.compress
        return compress
    return lambda data: data


class Index:
    """What stands at the end of a file: schemas, channels, statistics, and where the chunks are."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.chunks: list[ChunkIndex] = []
        self.metadata: list[MetadataIndex] = []
        self.counts: dict[int, int] = {}
        self.start_ns = 0
        self.end_ns = 0
        self._counted: deque[dict[int, int]] = deque(maxlen=REMEMBERED)

    @property
    def messages(self) -> int:
        """How many there are."""
        return sum(self.counts.values())

    def add_chunk(self, chunk: ChunkIndex, counts: dict[int, int]) -> None:
        """One more chunk, with so many messages per channel."""
        if not self.chunks or chunk.message_start_time < self.start_ns:
            self.start_ns = chunk.message_start_time
        self.end_ns = max(self.end_ns, chunk.message_end_time)
        self.chunks.append(chunk)
        self._counted.append(counts)
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def give_up_chunk(self) -> int:
        """Without the last chunk; where it began."""
        last = self.chunks.pop()
        for channel, count in (self._counted.pop() if self._counted else {}).items():
            self.counts[channel] -= count
        self.start_ns = min((chunk.message_start_time for chunk in self.chunks), default=0)
        self.end_ns = max((chunk.message_end_time for chunk in self.chunks), default=0)
        self.metadata = [each for each in self.metadata if each.offset < last.chunk_start_offset]
        return int(last.chunk_start_offset)

    def end(self, at: int) -> bytes:
        """All behind the data, which ends at this offset."""
        data_end = _bytes(DataEnd(0))
        summary_start = at + len(data_end)
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self.chunks)),
            (Opcode.METADATA_INDEX, list(self.metadata)),
        ]
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            if records:
                group = _bytes(*records)
                offsets += _bytes(SummaryOffset(opcode, summary_start + len(summary), len(group)))
                summary += group
        offsets_at = summary_start + len(summary)
        whole = bytes(summary + offsets)
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, summary_start, offsets_at), zlib.crc32(whole))
        return data_end + whole + _bytes(Footer(summary_start, offsets_at, crc)) + MAGIC

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=self.counts,
            chunk_count=len(self.chunks),
            message_count=self.messages,
            message_end_time=self.end_ns,
            message_start_time=self.start_ns,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


class McapFile:
    """A file that is written. Belongs to one thread. Raises OSError; what was whole before stays readable."""

    def __init__(
        self, path: Path, *, compression: str = "lz4", profile: str = PROFILE, chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        """Raises FileExistsError: nothing is written over."""
        self.path = path
        self.index = Index()
        self._compression = "" if compression == "none" else compression
        self._compress = compressor(compression)
        self._chunk_bytes = chunk_bytes
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._at = 0
        self._pieces: list[bytes] = []
        self._pending = 0
        self._entries: dict[int, list[int]] = {}
        self._start_ns = self._end_ns = 0
        self.lost = 0
        """Messages that were given up for want of room."""
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._write(MAGIC + _bytes(Header(profile, LIBRARY)))

    @property
    def size(self) -> int:
        """Bytes written and waiting, without the index."""
        return self._at + self._pending

    @property
    def pending(self) -> int:
        """Bytes that wait for their chunk."""
        return self._pending

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """The id of a schema, written when it is new."""
        key = (name, encoding, data)
        found = self._schemas.get(key)
        if found is None:
            found = self._schemas[key] = len(self._schemas) + 1
            record = Schema(id=found, data=data, encoding=encoding, name=name)
            self._write(_bytes(record))
            self.index.schemas[found] = record
        return found

    def keep_ids(self, record: Schema | Channel, *, is_in_chunk: bool = False) -> None:
        """A schema or channel of another file under the id that it has there; ``is_in_chunk``: it need not be written
        since a chunk has it."""
        if not is_in_chunk:
            self._write(_bytes(record))
        if isinstance(record, Schema):
            self.index.schemas[record.id] = record
        else:
            self.index.channels[record.id] = record

    def channel(self, topic: str, encoding: str, schema_id: int, metadata: dict[str, str]) -> int:
        """A new channel's id; 0 as ``schema_id`` for none."""
        if len(self.index.channels) >= 0xFFFF:
            raise OSError(errno.EOVERFLOW, "a recording has at most 65535 channels")
        found = len(self.index.channels) + 1
        record = Channel(found, topic, encoding, metadata, schema_id)
        self._write(_bytes(record))
        self.index.channels[found] = record
        return found

    def add(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """One message. Times in ns since 1970."""
        if not self._pieces:
            self._start_ns = self._end_ns = log_ns
        elif log_ns < self._start_ns:
            self._start_ns = log_ns
        elif log_ns > self._end_ns:
            self._end_ns = log_ns
        size = len(data) + _MESSAGE_BYTES
        entries = self._entries.get(channel)
        if entries is None:
            entries = self._entries[channel] = []
        entries += (log_ns, self._pending)
        head = _MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence & 0xFFFFFFFF, log_ns, publish_ns)
        self._pieces += (head, data)
        self._pending += size + 9
        if self._pending >= self._chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """Write the chunk that waits, if there is anything in it. Where the disk is full it is given up, and the file
        is as before."""
        if not self._pieces:
            return
        raw = small_joined(self._pieces, LARGE_BYTES)
        entries, start_ns, end_ns = self._entries, self._start_ns, self._end_ns
        self._pieces, self._entries, self._pending = [], {}, 0
        compression = self._compression if self._gets_smaller(raw) else ""
        if compression:
            raw = [b"".join(raw)]
        data = [self._compress(raw[0])] if compression else raw
        try:
            self.add_chunk(raw, data, compression, entries, start_ns, end_ns)
        except OSError:
            self.lost += sum(len(times) // 2 for times in entries.values())
            raise

    def add_chunk(
        self,
        raw: Sequence[bytes],
        data: Sequence[bytes],
        compression: str,
        entries: Mapping[int, list[int]],
        start_ns: int,
        end_ns: int,
    ) -> None:
        """A whole chunk, in pieces: its messages as they are, and as they are written; ``entries`` are by channel
        time, offset, time, offset, …"""
        name, raw_bytes, data_bytes = compression.encode(), sum(map(len, raw)), sum(map(len, data))
        length = 8 + 8 + 8 + 4 + 4 + len(name) + 8 + data_bytes
        crc = 0
        for piece in raw:
            crc = zlib.crc32(piece, crc)
        head = b"".join(
            (
                _CHUNK.pack(Opcode.CHUNK, length, start_ns, end_ns, raw_bytes, crc),
                _U32.pack(len(name)),
                name,
                _U64.pack(data_bytes),
            )
        )
        chunk_bytes = len(head) + data_bytes
        at, offsets, indexes = self._at + chunk_bytes, {}, []
        for channel, times in entries.items():
            record = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + 8 * len(times), channel, 8 * len(times))
            record += struct.pack(f"<{len(times)}Q", *times)
            offsets[channel] = at
            at += len(record)
            indexes.append(record)
        index = ChunkIndex(
            chunk_length=chunk_bytes,
            chunk_start_offset=self._at,
            compression=compression,
            compressed_size=data_bytes,
            message_end_time=end_ns,
            message_index_length=at - self._at - chunk_bytes,
            message_index_offsets=offsets,
            message_start_time=start_ns,
            uncompressed_size=raw_bytes,
        )
        self._write(head, *data, b"".join(indexes))
        self.index.add_chunk(index, {channel: len(times) // 2 for channel, times in entries.items()})

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """A record of names and values."""
        record = _bytes(Metadata(name, values))
        at = self._at
        self._write(record)
        self.index.metadata.append(MetadataIndex(at, len(record), name))

    def close(self, closing: Closing = dict) -> None:
        """Write what waits, ``closing`` as metadata, and the index.

        Where there is no room for it, the last chunks make room; raises the OSError then, as where there was none for
        what waited: the file is readable all the same.
        """
        problem: OSError | None = None
        try:
            try:
                self.flush()
            except OSError as error:
                problem = error
            while True:
                before = list(self.index.metadata)
                try:
                    self._write(self._tail(closing()))
                    break
                except OSError as error:
                    self.index.metadata = before
                    problem = error
                    if not self.index.chunks:
                        break
                    self._give_up_chunk()
        finally:
            os.close(self._file)
        if problem is not None:
            raise problem

    def abandon(self) -> None:
        """Close it as it is, without an index."""
        os.close(self._file)

    def _tail(self, closing: Mapping[str, Mapping[str, str]]) -> bytes:
        records = b""
        for name, values in closing.items():
            record = _bytes(Metadata(name, dict(values)))
            self.index.metadata.append(MetadataIndex(self._at + len(records), len(record), name))
            records += record
        return records + self.index.end(self._at + len(records))

    def _give_up_chunk(self) -> None:
        """Take the last chunk away, with what stands behind it."""
        before = self.index.messages
        self._at = self.index.give_up_chunk()
        self.lost += before - self.index.messages
        os.ftruncate(self._file, self._at)
        os.lseek(self._file, self._at, os.SEEK_SET)

    def _gets_smaller(self, raw: Sequence[bytes]) -> bool:
        """Whether it is worth the time to make a chunk smaller, as pieces of it tell."""
        size = sum(map(len, raw))
        if not self._compression or size <= SAMPLED_BYTES:
            return bool(self._compression)
        each, smaller = max(LEAST_SAMPLE_BYTES, SAMPLED_BYTES // len(raw)), 0.0
        for piece in raw:
            at = max(0, len(piece) - each) // 2
            sample = piece[at : at + each]
            smaller += len(self._compress(sample)) / len(sample) * len(piece)
        return smaller <= WORTH * size

    def _write(self, *pieces: bytes) -> None:
        """All of it or nothing."""
        left = [memoryview(piece) for piece in pieces if piece]
        written = 0
        try:
            while left:
                count = os.writev(self._file, left)
                written += count
                while left and count >= len(left[0]):
                    count -= len(left.pop(0))
                if count:
                    left[0] = left[0][count:]
        except OSError:
            os.ftruncate(self._file, self._at)
            os.lseek(self._file, self._at, os.SEEK_SET)
            raise
        self._at += written


def _bytes(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call, unused-ignore]
