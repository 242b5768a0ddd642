"""What a recording says of each robot in it: topics with their types and QoS, group, offers, what was latched."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from bridge.recording.bag import Bag
from bridge.recording.mcap_records import ChannelRecord
from bridge.recording.streams import CDR, OFFERS, PRESENCE, qos_of, split_topic
from macs_zenoh.protocol.guard import STOP_TOPIC
from macs_zenoh.protocol.messages import node_name
from macs_zenoh.protocol.robot_state import Offered, TopicQos
from macs_zenoh.protocol.schemas import Definition, definitions_in


def is_stop(topic: str) -> bool:
    """Whether a topic is an emergency stop, of a robot in a namespace as well."""
    return node_name(topic).endswith(node_name(STOP_TOPIC).removeprefix("nd_"))


@dataclass
class RecordedTopic:
    """A topic of a robot."""

    name: str
    type: str
    """As ``geometry_msgs/msg/Twist``."""
    qos: TopicQos
    channels: list[int] = field(default_factory=list)
    last: bytes | None = None
    """Of a latched topic: what it said last before the place where playing begins."""

    @property
    def is_latched(self) -> bool:
        """Whether late ones get the last message."""
        return self.qos.durability == "transient_local"


@dataclass
class RecordedRobot:
    """A robot of a recording."""

    id: int
    group: int = 0
    topics: dict[str, RecordedTopic] = field(default_factory=dict)
    offered: Offered = field(default_factory=Offered)
    definitions: dict[str, Definition] = field(default_factory=dict)

    def offers(self) -> Offered:
        """What it offers now: the recorded topics, and what else it offered then."""
        types = {topic.name: topic.type for topic in self.topics.values()}
        others = {
            name: of_type
            for name, of_type in self.offered.subscribers.items()
            if name not in types or name in self.offered.subscribers
        }
        qos = {**self.offered.qos, **{topic.name: topic.qos for topic in self.topics.values()}}
        return Offered(others, types, self.offered.services, self.offered.actions, qos)

    def moves_by(self, topic: str, named: Collection[str] = ()) -> str:
        """Why a topic may move, stop or release a robot that has it; empty: it only tells something.

        The emergency stop always may; of the others not those in ``named``, the names that somebody has given.
        """
        if is_stop(topic):
            return "it is the emergency stop"
        if topic in named:
            return ""
        if topic in self.offered.subscribers:
            return f"nodes of the robot listened to it, which may move it; to have it, name it: --topics {topic}"
        if self.offered.publishers and topic not in self.offered.publishers:
            return f"no node of the robot published it; to have it, name it: --topics {topic}"
        return ""


def recorded_robots(path: Path, wanted: Callable[[str], bool], start_s: float = 0.0) -> dict[int, RecordedRobot]:
    """The robots of a file, with those of their topics that are wanted. Reads the index, and of what was latched or
    said about robots before ``start_s`` the messages. Raises BadBag, ConfigError."""
    found: dict[int, RecordedRobot] = {}
    with Bag(path) as bag:
        start_ns = bag.start_ns + int(start_s * 1e9)
        for channel in bag.channels.values():
            _add(found, bag, channel, wanted)
        latched = {
            channel: topic
            for robot in found.values()
            for topic in robot.topics.values()
            if topic.is_latched
            for channel in topic.channels
        }
        about = {channel.id: channel.topic for channel in bag.channels.values() if channel.topic in (OFFERS, PRESENCE)}
        if start_s > 0:
            for message in bag.messages(lambda channel: channel.id in latched, end_ns=start_ns):
                latched[message.channel].last = message.data
        for message in bag.messages(lambda channel: channel.id in about):
            _said(found, about[message.channel], message.data)
    return found


def _add(found: dict[int, RecordedRobot], bag: Bag, channel: ChannelRecord, wanted: Callable[[str], bool]) -> None:
    named = split_topic(channel.topic)
    schema = bag.schema_of(channel)
    if named is None or channel.encoding != CDR or schema is None or not wanted(named[1]):
        return
    robot = found.setdefault(named[0], RecordedRobot(named[0]))
    topic = robot.topics.setdefault(named[1], RecordedTopic(named[1], schema.name, qos_of(channel.metadata)))
    topic.channels.append(channel.id)
    texts = definitions_in(schema.name, schema.data.decode("utf-8", "replace"))
    hashed = channel.metadata.get("topic_type_hash", "")
    if schema.name in texts:
        texts[schema.name] = Definition(texts[schema.name].text, hashed)
    robot.definitions = {**texts, **robot.definitions, schema.name: texts.get(schema.name, Definition(""))}


def _said(found: dict[int, RecordedRobot], channel: str, data: bytes) -> None:
    try:
        said = json.loads(data)
        if channel == OFFERS and said["robot"] in found:
            found[said["robot"]].offered = msgspec.convert(said["offers"], Offered)
        elif channel == PRESENCE:
            kind, _, number = str(said["agent"]).partition("/")
            if kind == "ros" and number.isdigit() and int(number) in found and 0 <= int(said["group"]) <= 255:
                found[int(number)].group = int(said["group"])
    except (ValueError, KeyError, TypeError, RecursionError, msgspec.ValidationError):
        return  # somebody else's file; what it says of robots' topics is enough
