"""Reads a file from its beginning, whether it is whole or not: what `repair` and `check` have in common.

Bounded: a chunk at a time is in memory.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from bridge.recording import bag
from bridge.recording.bag import MAGIC, MAX_RECORD_BYTES, BadBag
from bridge.recording.mcap_records import DATA_END, MAX_CHUNK_BYTES, Chunk, Fields, read_chunk, records_in

_HEAD = struct.Struct("<BQ")


class Found(NamedTuple):
    """A record of the data section: where it is, and its content; of the last one of a file that was cut off as much
    as there is."""

    opcode: int
    at: int
    data: bytes
    whole: bool = True


def opened(path: Path) -> BinaryIO:
    """The file, behind the magic bytes. Raises ConfigError, BadBag."""
    file = bag.opened(path)
    if file.read(len(MAGIC)) != MAGIC:
        file.close()
        raise BadBag(path, "it is no MCAP file")
    return file


def records(path: Path) -> Iterator[Found]:
    """The records up to the end of the data, or to where the file is cut off. Raises ConfigError, BadBag."""
    with opened(path) as file:
        size = file.seek(0, os.SEEK_END)
        at = file.seek(len(MAGIC))
        while at < size:
            head = file.read(9)
            if len(head) < 9:
                return
            opcode, length = _HEAD.unpack(head)
            left = size - at - 9
            if not 0 < opcode <= DATA_END or length > MAX_RECORD_BYTES:
                return  # what follows is none of ours: a hole, say, that a crashed machine left
            data = file.read(min(length, left))
            yield Found(opcode, at, data, whole=length <= left)
            if opcode == DATA_END or length > left:
                return
            at += 9 + length


def record_at(path: Path, at: int) -> Found:
    """The record that begins there, or is cut off there. Raises ConfigError, BadBag, ValueError: there is none."""
    with opened(path) as file:
        if at + 9 > file.seek(0, os.SEEK_END):
            raise ValueError(f"there is nothing at {at}")
        file.seek(at)
        head = file.read(9)
        opcode, length = _HEAD.unpack(head)
        data = file.read(min(length, MAX_RECORD_BYTES))
        return Found(opcode, at, data, whole=len(data) == length)


def salvaged(data: bytes) -> Chunk:
    """As much as can be read of a chunk that is cut off or damaged. Raises ValueError: nothing."""
    fields = Fields(data)
    fields.u64()
    fields.u64()
    size, crc, compression = fields.u64(), fields.u32(), fields.text()
    fields.u64()
    packed = fields.rest()
    if compression == "zstd":
        raw = _salvaged_zstd(packed)
    elif compression == "lz4":
        raw = _salvaged_lz4(packed)
    else:
        raw = packed
    return Chunk(raw[: min(size, MAX_CHUNK_BYTES)], crc)


def _salvaged_zstd(packed: bytes) -> bytes:
    import zstandard

    reading = zstandard.ZstdDecompressor().decompressobj()
    return _in_pieces(packed, reading.decompress, (zstandard.ZstdError,))


def _salvaged_lz4(packed: bytes) -> bytes:
    import lz4.frame  # type: ignore[import-untyped, unused-ignore]

    reading = lz4.frame.LZ4FrameDecompressor()
    return _in_pieces(packed, reading.decompress, (RuntimeError, EOFError))


def _in_pieces(packed: bytes, read: object, errors: tuple[type[Exception], ...]) -> bytes:
    assert callable(read)
    found = b""
    for start in range(0, len(packed), 4096):
        try:
            found += read(packed[start : start + 4096])
        except errors:
            break
        if len(found) > MAX_CHUNK_BYTES:
            break
    return found


def whole_records(raw: bytes) -> tuple[int, int]:
    """How many bytes of a chunk's content are whole records, and how many records that is."""
    end = count = 0
    try:
        for _, at, length in records_in(raw):
            end, count = at + length, count + 1
    except ValueError:
        pass
    return end, count


def checked_chunk(data: bytes) -> Chunk:
    """A whole chunk. Raises ValueError: damaged."""
    chunk = read_chunk(data)
    if not chunk.is_whole:
        raise ValueError(f"its checksum is {zlib.crc32(chunk.raw):#010x}, not {chunk.crc:#010x}")
    return chunk
