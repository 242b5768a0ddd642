"""Recordings that tests make, and what is in them."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from bridge.recording.bag import Bag
from bridge.recording.disk import Entry
from bridge.recording.mcap_file import McapFile
from bridge.recording.streams import Channel, robot_channel
from macs_zenoh.protocol.robot_state import TopicQos

S = 1_000_000_000
BEGIN = 1_700_000_000 * S
STRING = "string data\n"


def cdr(text: str) -> bytes:
    """std_msgs/String."""
    data = text.encode() + b"\0"
    return b"\x00\x01\x00\x00" + struct.pack("<I", len(data)) + data


def string_channel(robot: int = 7, topic: str = "/chatter", durability: str = "volatile") -> Channel:
    return robot_channel(robot, topic, "std_msgs/msg/String", STRING, "", TopicQos("reliable", durability))


def entries(channel: Channel, count: int, *, start: int = BEGIN, step: int = S // 100) -> Iterator[Entry]:
    """Numbered texts, one each hundredth of a second unless said otherwise."""
    for number in range(count):
        data = cdr(f"message {number}")
        yield Entry(channel, channel.next(len(data)), start + number * step, data)


def write(path: Path, count: int = 1000, *, channel: Channel | None = None, **options: object) -> Path:
    """A finished file."""
    file = McapFile(path, **options)  # type: ignore[arg-type]
    fill(file, channel or string_channel(), count)
    file.close()
    return path


def fill(file: McapFile, channel: Channel, count: int, start: int = BEGIN) -> None:
    schema = file.schema(channel.type, "ros2msg", channel.schema.encode())
    number = file.channel(channel.topic, channel.encoding, schema, channel.metadata)
    for entry in entries(channel, count, start=start):
        file.add(number, entry.sequence, entry.log_ns, entry.log_ns, entry.data)


def texts(bag: Bag, **options: int) -> list[bytes]:
    return [message.data for message in bag.messages(**options)]
