"""New recordings out of others: several as one, and a part of one. A chunk of each is in memory."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from bridge.recording.bag import CACHE_BYTES, Bag
from bridge.recording.mcap_file import McapFile
from bridge.recording.mcap_records import ChannelRecord, Message
from bridge.recording.repair import Progress, quiet
from bridge.recording.streams import qos_of
from macs_zenoh.errors import ConfigError

STEP = 1000
"""Progress is told once in so many messages."""


class Copy:
    """A file that takes messages of others; channels that are the same in several become one."""

    def __init__(self, out: Path, profile: str, compression: str) -> None:
        """Raises ConfigError."""
        try:
            self._file = McapFile(out, compression=compression, profile=profile)
        except OSError as error:
            raise ConfigError(str(out), error.strerror or str(error)) from error
        self._ids: dict[tuple[int, int], int] = {}
        self._same: dict[tuple[object, ...], int] = {}
        self.messages = 0

    def add(self, number: int, bag: Bag, message: Message) -> None:
        """A message of a file, which has this number here. Raises OSError."""
        target = self._ids.get((number, message.channel))
        if target is None:
            target = self._ids[number, message.channel] = self._channel(bag, bag.channels[message.channel])
        self._file.add(target, message.sequence, message.log_ns, message.publish_ns, message.data)
        self.messages += 1

    def _channel(self, bag: Bag, channel: ChannelRecord) -> int:
        schema = bag.schema_of(channel)
        key = (channel.topic, channel.encoding, schema and schema[1:], tuple(sorted(channel.metadata.items())))
        found = self._same.get(key)
        if found is None:
            schema_id = self._file.schema(schema.name, schema.encoding, schema.data) if schema is not None else 0
            found = self._file.channel(channel.topic, channel.encoding, schema_id, channel.metadata)
            self._same[key] = found
        return found

    def take_metadata(self, bag: Bag) -> None:
        """What a file says of itself."""
        for name, values in bag.metadata():
            self._file.metadata(name, {**values, "file": bag.path.name})

    def close(self) -> None:
        """Finish it. Raises OSError."""
        self._file.close()


def merge(paths: Sequence[Path], out: Path, compression: str = "lz4", progress: Progress = quiet) -> int:
    """Write the messages of several files as one, by time; how many. Raises BadBag, ConfigError."""
    with ExitStack() as stack:
        bags = [stack.enter_context(Bag(path, cache_bytes=CACHE_BYTES // len(paths))) for path in paths]
        profiles = {bag.profile for bag in bags}
        copy = Copy(out, profiles.pop() if len(profiles) == 1 else "", compression)
        total = sum(bag.messages_in_all for bag in bags)

        def of(number: int, bag: Bag) -> Iterator[tuple[int, int, Message]]:
            return ((message.log_ns, number, message) for message in bag.messages())

        each = heapq.merge(*(of(number, bag) for number, bag in enumerate(bags)), key=lambda entry: entry[:2])
        return _copied(copy, bags, ((number, message) for _, number, message in each), total, progress)


def cut(
    path: Path,
    out: Path,
    wanted: Callable[[ChannelRecord], bool],
    *,
    start_ns: int = 0,
    end_ns: int = 1 << 63,
    compression: str = "lz4",
    progress: Progress = quiet,
) -> int:
    """Write a part of a file, and what its latched topics said last before it; how many messages.

    Raises BadBag, ConfigError.
    """
    with Bag(path) as bag:
        copy = Copy(out, bag.profile, compression)

        def messages() -> Iterator[tuple[int, Message]]:
            for message in _latched_before(bag, wanted, start_ns):
                yield 0, message._replace(log_ns=start_ns)
            for message in bag.messages(wanted, start_ns=start_ns, end_ns=end_ns):
                yield 0, message

        return _copied(copy, [bag], messages(), bag.messages_in_all, progress)


def _latched_before(bag: Bag, wanted: Callable[[ChannelRecord], bool], start_ns: int) -> list[Message]:
    latched = {
        channel.id
        for channel in bag.channels.values()
        if wanted(channel) and qos_of(channel.metadata).durability == "transient_local"
    }
    if not latched or start_ns <= bag.start_ns:
        return []
    last = {message.channel: message for message in bag.messages(lambda c: c.id in latched, end_ns=start_ns)}
    return list(last.values())


def _copied(
    copy: Copy, bags: Sequence[Bag], messages: Iterator[tuple[int, Message]], total: int, progress: Progress
) -> int:
    try:
        try:
            for number, message in messages:
                copy.add(number, bags[number], message)
                if copy.messages % STEP == 0:
                    progress("copying", copy.messages, total)
            for bag in bags:
                copy.take_metadata(bag)
        finally:
            copy.close()
    except OSError as error:
        raise ConfigError("the new file", error.strerror or str(error)) from error
    return copy.messages
