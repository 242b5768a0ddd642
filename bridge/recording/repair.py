"""Makes a whole recording of one whose writer was killed, or that is damaged, and says what is wrong with one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Channel, Schema

from bridge.recording import scan
from bridge.recording.bag import BadBag, Bag, Unfinished
from bridge.recording.mcap_file import McapFile
from bridge.recording.mcap_records import (
    CHANNEL,
    CHUNK,
    DATA_END,
    HEADER,
    MESSAGE,
    METADATA,
    SCHEMA,
    Chunk,
    Fields,
    channel_record,
    message_in,
    records_in,
    schema_record,
)
from macs_zenoh.errors import ConfigError

Progress = Callable[[str, int, int], None]
"""(what is done, bytes done, of how many)"""


def quiet(what: str, done: int, steps: int) -> None:
    """No progress is shown."""


@dataclass
class Repaired:
    """What became of a file.

    Attributes:
        messages: in the new file.
        chunks: whole ones that were taken as they are.
        damaged: chunks of which a part was taken, or nothing.
        cut_bytes: at the end, that are nothing.
    """

    messages: int = 0
    chunks: int = 0
    damaged: int = 0
    cut_bytes: int = 0
    problems: list[str] = field(default_factory=list)


def repair(path: Path, out: Path, progress: Progress = quiet) -> Repaired:
    """Write a whole file of what there is in ``path``; chunks that are whole are not compressed again.

    Raises BadBag where nothing can be read, ConfigError where a file cannot be opened or is there already.
    """
    done, size = Repaired(), path.stat().st_size if path.exists() else 0
    try:
        file = McapFile(out, compression="lz4", profile=_profile(path))
    except OSError as error:
        raise ConfigError(str(out), error.strerror or str(error)) from error
    end, seen = 0, set()
    try:
        for found in scan.records(path):
            progress(path.name, found.at, size)
            if found.opcode == DATA_END:
                end = size
                break
            end = found.at + 9 + len(found.data)
            seen.add(found.at)
            try:
                _take(file, found, done)
            except ValueError as error:
                done.problems.append(f"at {found.at}: {error}")
        if _take_by_index(path, file, seen, done):
            end = size
        done.cut_bytes = size - end
        file.close()
    except OSError as error:
        raise ConfigError(str(out), error.strerror or str(error)) from error
    done.messages = file.index.messages
    if not done.messages and not file.index.channels:
        out.unlink()
        raise BadBag(path, "there is nothing in it that can be read")
    return done


def _take_by_index(path: Path, file: McapFile, seen: set[int], done: Repaired) -> bool:
    """What the index knows of and reading from the beginning did not come to, since a record in between says a wrong
    length; whether there is an index."""
    try:
        with Bag(path) as bag:
            for schema in bag.schemas.values():
                if schema.id not in file.index.schemas:
                    file.keep_ids(Schema(schema.id, schema.data, schema.encoding, schema.name))
            for channel in bag.channels.values():
                if channel.id not in file.index.channels:
                    file.keep_ids(
                        Channel(channel.id, channel.topic, channel.encoding, channel.metadata, channel.schema_id)
                    )
            for chunk in bag.chunks:
                if chunk.offset not in seen and (found := scan.record_at(path, chunk.offset)).opcode == CHUNK:
                    _take_chunk(file, found, done)
    except (BadBag, ValueError):
        return False
    return True


def _profile(path: Path) -> str:
    for found in scan.records(path):
        try:
            return Fields(found.data).text() if found.opcode == HEADER else ""
        except ValueError:
            break
    return ""


def _take(file: McapFile, found: scan.Found, done: Repaired) -> None:
    if found.opcode == CHUNK:
        _take_chunk(file, found, done)
    elif not found.whole:
        done.problems.append(f"at {found.at}: a record is cut off")
    elif found.opcode in (SCHEMA, CHANNEL):
        _take_name(file, found.opcode, found.data, is_in_chunk=False)
    elif found.opcode == MESSAGE:
        message = message_in(found.data, 0, len(found.data))
        file.add(message.channel, message.sequence, message.log_ns, message.publish_ns, message.data)
    elif found.opcode == METADATA:
        fields = Fields(found.data)
        file.metadata(fields.text(), fields.pairs())


def _take_name(file: McapFile, opcode: int, data: bytes, *, is_in_chunk: bool) -> None:
    if opcode == SCHEMA:
        schema = schema_record(data)
        known: object = file.index.schemas.get(schema.id)
        if known is None:
            file.keep_ids(Schema(schema.id, schema.data, schema.encoding, schema.name), is_in_chunk=is_in_chunk)
        return
    channel = channel_record(data)
    if channel.id not in file.index.channels:
        file.keep_ids(
            Channel(channel.id, channel.topic, channel.encoding, channel.metadata, channel.schema_id),
            is_in_chunk=is_in_chunk,
        )


def _take_chunk(file: McapFile, found: scan.Found, done: Repaired) -> None:
    fields = Fields(found.data)
    fields.u64()
    fields.u64()
    _, _, compression = fields.u64(), fields.u32(), fields.text()
    try:
        chunk = scan.checked_chunk(found.data) if found.whole else None
    except ValueError as error:
        done.problems.append(f"chunk at {found.at}: {error}")
        chunk = None
    if chunk is not None:
        done.chunks += 1
        packed = fields.take(fields.u64())
        _put_chunk(file, chunk.raw, packed, compression)
        return
    done.damaged += 1
    try:
        part = scan.salvaged(found.data)
    except ValueError:
        part = Chunk(b"", 0)
    end, count = scan.whole_records(part.raw)
    done.problems.append(f"chunk at {found.at}: {count} whole messages of it are kept")
    if end:
        _put_chunk(file, part.raw[:end], part.raw[:end], "")


def _put_chunk(file: McapFile, raw: bytes, packed: bytes, compression: str) -> None:
    entries: dict[int, list[int]] = {}
    times: list[int] = []
    for opcode, at, length in records_in(raw):
        if opcode == MESSAGE:
            message = message_in(raw, at, length)
            entries.setdefault(message.channel, []).extend((message.log_ns, at - 9))
            times.append(message.log_ns)
        elif opcode in (SCHEMA, CHANNEL):
            _take_name(file, opcode, raw[at : at + length], is_in_chunk=True)
    file.add_chunk([raw], [packed], compression, entries, min(times, default=0), max(times, default=0))


def problems(path: Path, progress: Progress = quiet) -> list[str]:
    """What is wrong with a recording; nothing is said of one that is whole. Reads all of it.

    Raises BadBag for what is no recording, ConfigError.
    """
    found: list[str] = []
    try:
        bag: Bag | None = Bag(path)
    except Unfinished as error:
        bag = None
        found.append(error.problem)
    counts: dict[int, int] = {}
    size, chunks, ended = path.stat().st_size, 0, False
    for record in scan.records(path):
        progress(path.name, record.at, size)
        ended = ended or record.opcode == DATA_END
        try:
            if not record.whole:
                raise ValueError("it is cut off")
            if record.opcode == CHUNK:
                chunks += 1
                _check_chunk(record, counts, bag)
            elif record.opcode == MESSAGE:
                message = message_in(record.data, 0, len(record.data))
                counts[message.channel] = counts.get(message.channel, 0) + 1
        except ValueError as error:
            found.append(f"at {record.at}: {error}")
    if not ended:
        found.append("the data has no end")
    if bag is not None:
        with bag:
            found += _index_problems(bag, counts, chunks)
    return found


def _check_chunk(record: scan.Found, counts: dict[int, int], bag: Bag | None) -> None:
    fields = Fields(record.data)
    start_ns, end_ns = fields.u64(), fields.u64()
    chunk = scan.checked_chunk(record.data)
    for opcode, at, length in records_in(chunk.raw):
        if opcode != MESSAGE:
            continue
        message = message_in(chunk.raw, at, length)
        counts[message.channel] = counts.get(message.channel, 0) + 1
        if not start_ns <= message.log_ns <= end_ns:
            raise ValueError(f"a message of another time than its chunk, {message.log_ns}")
        if bag is not None and message.channel not in bag.channels:
            raise ValueError(f"a message of channel {message.channel}, which the index does not have")


def _index_problems(bag: Bag, counts: dict[int, int], chunks: int) -> list[str]:
    found = []
    for channel in bag.channels.values():
        told, there = bag.counts.get(channel.id, 0), counts.get(channel.id, 0)
        if told != there:
            found.append(f"{channel.topic}: the index says {told} messages, there are {there}")
        schema = bag.schema_of(channel)
        if channel.schema_id and schema is None:
            found.append(f"{channel.topic}: its schema is missing")
        elif channel.encoding == "cdr" and (schema is None or not schema.data.strip()):
            found.append(f"{channel.topic}: its schema is empty")
    if len(bag.chunks) != chunks:
        found.append(f"the index says {len(bag.chunks)} chunks, there are {chunks}")
    return found
