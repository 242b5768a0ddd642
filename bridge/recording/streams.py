"""What a recording has: channels, and the names and texts that stand in their metadata. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from macs_zenoh.protocol.robot_state import TopicQos
from macs_zenoh.protocol.schemas import full_type

CDR, JSON = "cdr", "json"
ROS2MSG = "ros2msg"

PREFIX = "/macs"
"""Before the names of all channels that are no topics of robots."""
PRESENCE, STATUS, STOPS, CONTROL, DEADMAN, REFUSALS, DROPS, CALLS, MESSAGES, LOST, OFFERS, NOTES, TOKENS, TRACES = (
    f"{PREFIX}/{name}"
    for name in (
        "presence",
        "status",
        "stops",
        "control",
        "deadman",
        "refusals",
        "drops",
        "calls",
        "messages",
        "lost",
        "offers",
        "notes",
        "tokens",
        "traces",
    )
)
LOST_BEFORE = f"{PREFIX}/lost_before"
"""JSON channels: who came and left; a robot's state; and what of it changed."""


@dataclass(eq=False)
class Channel:
    """One channel of a recording, whatever files it goes on in.

    Attributes:
        topic: its name in the file, as ``/7/camera``.
        encoding: of its messages, `CDR` or `JSON`.
        type: of CDR, as ``sensor_msgs/msg/Image``.
        schema: the text for it; never empty for CDR.
        metadata: what else there is to know.
        latched: whether the last message is worth repeating in a file that begins later.
        count: messages so far, which numbers them.
    """

    topic: str
    encoding: str = JSON
    type: str = ""
    schema: str = ""
    metadata: dict[str, str] = field(default_factory=dict)
    latched: bool = False
    count: int = 0
    bytes: int = 0

    def next(self, size: int) -> int:
        """The number of one more message, of so many bytes."""
        self.count += 1
        self.bytes += size
        return self.count


def robot_topic(robot: int, topic: str) -> str:
    """``/7/camera`` of robot 7's ``/camera``."""
    return f"/{robot}{topic if topic.startswith('/') else '/' + topic}"


def split_topic(name: str) -> tuple[int, str] | None:
    """The robot and its topic of a channel's name; None for other channels."""
    robot, _, topic = name.removeprefix("/").partition("/")
    return (int(robot), f"/{topic}") if robot.isascii() and robot.isdigit() and topic and len(robot) < 6 else None


def command_topic(sender: str, robot: str, topic: str) -> str:
    """Where commands are recorded as they were sent: ``/sent/unity/256/7/cmd_vel``."""
    return f"/sent/{sender}/{robot}{topic if topic.startswith('/') else '/' + topic}"


def robot_channel(robot: int, topic: str, of_type: str, schema: str, hash_: str, qos: TopicQos) -> Channel:
    """The channel of a robot's topic."""
    metadata = {
        "offered_qos_profiles": qos_text(qos),
        "topic_type_hash": hash_,
        "robot": str(robot),
        "topic": topic,
        "sender": f"ros/{robot}",
    }
    latched = qos.durability == "transient_local"
    return Channel(robot_topic(robot, topic), CDR, full_type(of_type), schema, metadata, latched)


_RELIABILITY = {"reliable": 1, "best_effort": 2}
_DURABILITY = {"transient_local": 1, "volatile": 2}
_ENDLESS = "    sec: 9223372036\n    nsec: 854775807"


def qos_text(qos: TopicQos) -> str:
    """What rosbag2 has in ``offered_qos_profiles``, with numbers, which every version of it reads."""
    return (
        "- history: 3\n"
        "  depth: 0\n"
        f"  reliability: {_RELIABILITY.get(qos.reliability, 1)}\n"
        f"  durability: {_DURABILITY.get(qos.durability, 2)}\n"
        f"  deadline:\n{_ENDLESS}\n"
        f"  lifespan:\n{_ENDLESS}\n"
        "  liveliness: 1\n"
        f"  liveliness_lease_duration:\n{_ENDLESS}\n"
        "  avoid_ros_namespace_conventions: false"
    )


def qos_of(metadata: Mapping[str, str]) -> TopicQos:
    """The other way, of whatever wrote it: numbers or words."""
    said: dict[str, Any] = {}
    for line in metadata.get("offered_qos_profiles", "").splitlines():
        name, _, value = line.strip(" -").partition(":")
        said.setdefault(name.strip(), value.strip().strip("'\""))
    names = {
        "reliability": {**{str(n): w for w, n in _RELIABILITY.items()}, **{w: w for w in _RELIABILITY}},
        "durability": {**{str(n): w for w, n in _DURABILITY.items()}, **{w: w for w in _DURABILITY}},
    }
    return TopicQos(
        names["reliability"].get(said.get("reliability", ""), "reliable"),
        names["durability"].get(said.get("durability", ""), "volatile"),
    )
