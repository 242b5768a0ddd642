"""A recording as a bag of ROS 2: a folder that `ros2 bag` and rclpy programs read.

ROS takes no names of topics that begin with a number, so ``/7/camera`` becomes ``/robot_7/camera``; JSON channels
become texts (std_msgs/String), so that nothing is left out.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

from bridge.recording.bag import BadBag, Bag
from bridge.recording.copying import STEP
from bridge.recording.mcap_records import ChannelRecord
from bridge.recording.repair import Progress, quiet
from bridge.recording.streams import CDR, JSON, qos_of
from macs_zenoh.errors import ConfigError, MissingExtra

STORAGES = ("mcap", "sqlite3")
VERSION = 8
"""Of the folder's metadata: ROS 2 Jazzy writes 9 and reads this as well."""
_STRING = "std_msgs/msg/String"


class _Target(NamedTuple):
    connection: Any
    is_text: bool


def ros_name(topic: str) -> str:
    """A name that ROS takes: ``/7/camera`` → ``/robot_7/camera``, ``/sent/unity/256/7/x`` →
    ``/sent/unity/id_256/id_7/x``."""
    levels = re.sub(r"[^A-Za-z0-9_/]", "_", topic).strip("/").split("/")
    first, *others = [level or "_" for level in levels]
    names = [f"robot_{first}" if first[0].isdigit() else first]
    names += [f"id_{level}" if level[0].isdigit() else level for level in others]
    return "/" + "/".join(names)


def to_rosbag2(path: Path, out: Path, storage: str = "mcap", progress: Progress = quiet) -> int:
    """Write the folder; how many messages. Raises BadBag, ConfigError, MissingExtra."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingExtra("bags of ROS 2", "rosbags", "record") from error
    if out.exists():
        raise ConfigError(str(out), "it exists already, and nothing is written over")
    texts = get_typestore(Stores.ROS2_JAZZY)
    written = 0
    with Bag(path) as bag:
        writer = Writer(out, version=VERSION, storage_plugin=StoragePlugin[storage.upper()])
        targets: dict[int, _Target] = {}
        names: set[str] = set()

        def target(channel: ChannelRecord) -> _Target:
            name = ros_name(channel.topic)
            while name in names:
                name += "_"
            names.add(name)
            if channel.encoding != CDR:
                return _Target(writer.add_connection(name, _STRING, typestore=texts), is_text=True)
            schema = bag.schema_of(channel)
            if schema is None or schema.encoding != "ros2msg" or not schema.data:
                raise BadBag(path, f"{channel.topic} has no schema that ROS understands")
            text = schema.data.decode(errors="replace")
            hashed = _hash(text, schema.name) or channel.metadata.get("topic_type_hash", "") or "RIHS01_"
            return _Target(
                writer.add_connection(
                    name, schema.name, msgdef=text, rihs01=hashed, offered_qos_profiles=_qos(channel)
                ),
                is_text=False,
            )

        try:
            with writer:
                for message in bag.messages(lambda channel: channel.encoding in (CDR, JSON)):
                    found = targets.get(message.channel)
                    if found is None:
                        found = targets[message.channel] = target(bag.channels[message.channel])
                    data = _text(texts, message.data) if found.is_text else message.data
                    writer.write(found.connection, message.log_ns, data)
                    written += 1
                    if written % STEP == 0:
                        progress("converting", written, bag.messages_in_all)
        except OSError as error:
            raise ConfigError(str(out), error.strerror or str(error)) from error
    return written


def _hash(text: str, name: str) -> str:
    """The hash of a type as `rosbags` has it, which opens no bag with another one (of types with a char it is not what
    ROS has; ROS does not look at it). Empty where it cannot read the type, as one with a wstring."""
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    try:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text, name))
        return str(store.hash_rihs01(name))
    except TypesysError:
        return ""


def _text(store: Any, data: bytes) -> bytes:
    return bytes(store.serialize_cdr(store.types[_STRING](data=data.decode(errors="replace")), _STRING))


def _qos(channel: ChannelRecord) -> list[Any]:
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    said = qos_of(channel.metadata)
    endless = QosTime(9223372036, 854775807)
    return [
        Qos(
            history=QosHistory.UNKNOWN,
            depth=0,
            reliability=QosReliability[said.reliability.upper()],
            durability=QosDurability[said.durability.upper()],
            deadline=endless,
            lifespan=endless,
            liveliness=QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=endless,
            avoid_ros_namespace_conventions=False,
        )
    ]
