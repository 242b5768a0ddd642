"""What a headset says, judged frame by frame as it comes, and what is learned of it. Pure.

Each rule is a check of its own. What a headset never says is never judged: one that only listens is one too.
"""

from __future__ import annotations

import json
import re
from enum import Enum
from typing import Any, NamedTuple

from macs_zenoh.errors import WireError
from macs_zenoh.protocol.messages import MANAGERS, AddNode, NodeType, RemoveNode, node_name
from macs_zenoh.protocol.wire import Frame

from .checks import Check, Level, Verdicts

STRICT = Level.STRICT

CHECKS: tuple[Check, ...] = (
    Check("frames.sizes", "The sizes in its frames add up."),
    Check("frames.type", "The header's agent type is 0, 1 or 2."),
    Check("frames.destinations", "A message of an interface node names a robot or a group."),
    Check("frames.management", "Management data is a JSON object that names a manager."),
    Check("frames.manager", "The manager is one that routers have."),
    Check("frames.metadata", "Metadata is a JSON object, and never empty where there is a message."),
    Check("frames.metadata_keys", "It has the seven keys."),
    Check("frames.metadata_types", "Their values are of their types, and fit."),
    Check("frames.sender_type", "The sender's type is 2, as the configuration says."),
    Check("frames.sender_id", "The sender's id is the one that it was given last.", STRICT),
    Check("nodes.node_type", "The node type is one of 1 to 5."),
    Check("nodes.data_type", "A type is written pkg/Name."),
    Check("nodes.cdr", "Data of nodes begins as ROS 2 writes it: 00 01 00 00."),
    Check(
        "nodes.direction", "A headset sends commands (2), calls (3), answers (4) and goals (5), never topic data (1)."
    ),
    Check(
        "registering.one_frame", "A registration is one frame: management data, and a message that says what to do."
    ),
    Check("registering.agrees", "Management data and message name the same node."),
    Check("registering.name", "nodeName is nd_ and the topic's name with / and ~ as _."),
    Check("registering.registrant", "The registrant is type 2, with the id that it was given last."),
    Check("registering.values", "bufferSize is a number from 0, dropNew and isLatched are true or false."),
    Check("registering.lists", "registrarAgentIds and registrarGroupIds are lists of numbers."),
    Check("online.question", "A question who is online has metadata with a requestId, and no manager."),
    Check("heartbeat.form", "A heartbeat carries the message of eight zero bytes."),
    Check("offline.form", "Who leaves says so with its own id, and the message of eight zero bytes."),
)

_KEYS: dict[str, tuple[type, int]] = {
    "senderAgentType": (int, 0xFF),
    "senderAgentId": (int, 0xFFFF),
    "requestId": (int, 0xFFFFFFFF),
    "messageManager": (str, 0),
    "nodeType": (int, 0xFF),
    "nodeName": (str, 0),
    "dataExchangeType": (str, 0),
}
_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*")
_EMPTY = bytes(8)
_HUMP = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


class Kind(Enum):
    """What a frame is for."""

    CONFIGURATION = "AgentclientConfigurer"
    HEARTBEAT = "HeartbeatHandler"
    ONLINE = "OnlineAgentsGetter"
    REGISTRATION = "RosAgentNodeRegistrationForwarder"
    OFFLINE = "UnityAgentclientRemover"
    OTHER = "another manager"
    MESSAGE = "a message"
    BAD = "unreadable"


class Node(NamedTuple):
    """An interface node that the headset registered."""

    node_type: int
    name: str
    topic: str
    data_type: str
    robot: int


class Said(NamedTuple):
    """A frame, read as far as it can be: ``management`` with its keys in snake_case."""

    kind: Kind
    management: dict[str, Any]
    metadata: dict[str, Any]
    data: bytes
    at: float
    whole: bytes


class ClientFrames:
    """Judges what one headset says. ``id`` is the one of those ``given`` that it has answered to last."""

    def __init__(self, verdicts: Verdicts) -> None:
        self.id = 0
        self.given: set[int] = set()
        self.nodes: dict[tuple[int, str], Node] = {}
        self._verdicts = verdicts

    def take(self, frame: Frame | WireError, now: float) -> Said:
        """Judge a frame and remember what it says."""
        if isinstance(frame, WireError):
            self._verdicts.fail("frames.sizes", str(frame))
            return Said(Kind.BAD, {}, {}, b"", now, b"")
        self._verdicts.hold("frames.sizes")
        kind_of = frame.header.agent_type
        self._verdicts.hold("frames.type", kind_of in (0, 1, 2), f"it is {kind_of}")
        message = bytes(frame.message)
        if not frame.has_management:
            metadata = self._metadata(bytes(frame.metadata), message)
            said = Said(Kind.MESSAGE, {}, metadata, bytes(frame.body), now, bytes(frame.data))
            self._node_message(said, frame)
            return said
        management = self._management(frame.management)
        kind = _kind(management)
        metadata = self._metadata(bytes(frame.metadata), message) if message != _EMPTY else {}
        said = Said(kind, management, metadata, bytes(frame.body), now, bytes(frame.data))
        self._judge_management(said, message)
        return said

    def _judge_management(self, said: Said, message: bytes) -> None:
        hold = self._verdicts.hold
        if said.kind is Kind.CONFIGURATION:
            own = said.management.get("agent_id")
            self.id = own if own in self.given else self.id
        elif said.kind is Kind.HEARTBEAT:
            hold("heartbeat.form", message == _EMPTY, f"its message is {message[:100]!r}")
        elif said.kind is Kind.OFFLINE:
            own = said.management.get("agent_id")
            hold("offline.form", message == _EMPTY and own == self.id, f"it names {own} and is {self.id}")
        elif said.kind is Kind.ONLINE:
            plain = "requestId" in said.metadata and not said.metadata.get("messageManager")
            hold("online.question", plain, f"its metadata is {said.metadata}")
        elif said.kind is Kind.REGISTRATION:
            self._registration(said, message)

    def _management(self, raw: bytes) -> dict[str, Any]:
        found = _object(raw)
        management = {_HUMP.sub("_", key).lower(): value for key, value in (found or {}).items()}
        manager = management.get("message_manager")
        if self._verdicts.hold("frames.management", isinstance(manager, str), f"it is {raw[:200]!r}"):
            self._verdicts.hold("frames.manager", manager in MANAGERS, f"it is {manager!r}")
        return management

    def _metadata(self, raw: bytes, message: bytes) -> dict[str, Any]:
        found = _object(raw)
        if not self._verdicts.hold("frames.metadata", found is not None, f"the message is {message[:200]!r}"):
            return {}
        assert found is not None
        missing = [key for key in _KEYS if key not in found]
        self._verdicts.hold("frames.metadata_keys", not missing, f"{', '.join(missing)} is missing in {raw[:300]!r}")
        wrong = [key for key, value in found.items() if key in _KEYS and not _fits(value, *_KEYS[key])]
        self._verdicts.hold("frames.metadata_types", not wrong, f"{', '.join(wrong)} in {raw[:300]!r}")
        if not missing and not wrong:
            sender = found["senderAgentType"], found["senderAgentId"]
            self._verdicts.hold("frames.sender_type", sender[0] == 2, f"it is {sender[0]}")
            if self.id:
                self._verdicts.hold(
                    "frames.sender_id", sender[1] == self.id, f"it is {sender[1]}, given was {self.id}"
                )
        return found

    def _node_message(self, said: Said, frame: Frame) -> None:
        if not said.metadata.get("nodeName"):
            return
        hold = self._verdicts.hold
        named = any(frame.header.ids) or any(frame.header.groups)
        hold("frames.destinations", named, f"{said.metadata['nodeName']} goes to nobody")
        node_type, data_type = said.metadata.get("nodeType"), said.metadata.get("dataExchangeType")
        hold("nodes.node_type", node_type in list(NodeType), f"it is {node_type}")
        hold("nodes.direction", node_type != NodeType.SUBSCRIBER, f"{said.metadata['nodeName']} is of type 1")
        hold("nodes.data_type", _TYPE.fullmatch(str(data_type)), f"it is {data_type!r}")
        if node_type in (2, 3, 4) and said.metadata.get("messageManager") in ("", None, "InterfaceCallFailure"):
            begins = said.data[:4] == b"\x00\x01\x00\x00"
            hold("nodes.cdr", begins, f"data of {said.metadata['nodeName']} begins {said.data[:4].hex(' ')}")

    # -- registrations -----------------------------------------------------------------------------------------------

    def _registration(self, said: Said, message: bytes) -> None:
        hold, verb, inner = self._verdicts.hold, said.metadata.get("messageManager"), _object(said.data)
        whole = verb in (AddNode.manager, RemoveNode.manager) and inner is not None
        if not hold("registering.one_frame", whole, f"the message is {message[:200]!r}") or inner is None:
            return
        outer = said.management
        same = all(inner.get(name) == outer.get(_HUMP.sub("_", name).lower()) for name in ("nodeType", "nodeName"))
        hold("registering.agrees", same, f"{outer} carries {inner}")
        node_type, name = inner.get("nodeType"), inner.get("nodeName")
        hold("nodes.node_type", node_type in list(NodeType), f"it is {node_type}")
        self._registrant(outer, inner)
        lists = [outer.get(key, []) for key in ("registrar_agent_ids", "registrar_group_ids")]
        numbers = all(isinstance(each, list) and all(type(one) is int for one in each) for each in lists)
        if not hold("registering.lists", numbers, f"they are {lists}"):
            return
        if verb == AddNode.manager and isinstance(name, str) and isinstance(node_type, int):
            self._added(inner, node_type, name, lists[0])
        elif (node_type, name) in self.nodes and not any(lists[1]):
            self.nodes.pop((int(node_type or 0), str(name)))

    def _registrant(self, outer: dict[str, Any], inner: dict[str, Any]) -> None:
        named = inner.get("registrantAgentType"), inner.get("registrantAgentId"), outer.get("registrant_agent_id")
        if self.id:
            true = named == (2, self.id, self.id)
            self._verdicts.hold("registering.registrant", true, f"it is {named}, given was {self.id}")

    def _added(self, inner: dict[str, Any], node_type: int, name: str, robots: list[int]) -> None:
        hold = self._verdicts.hold
        topic, data_type = str(inner.get("tosName", "")), str(inner.get("dataExchangeType", ""))
        hold("registering.name", name == node_name(topic), f"{topic!r} is called {name!r}, not {node_name(topic)!r}")
        hold("nodes.data_type", _TYPE.fullmatch(data_type), f"it is {data_type!r}")
        size, flags = inner.get("bufferSize", 10), [inner.get(key, False) for key in ("dropNew", "isLatched")]
        right = type(size) is int and size >= 0 and all(type(flag) is bool for flag in flags)
        hold("registering.values", right, f"they are {size!r}, {flags}")
        robot = robots[0] if robots else 1
        self.nodes[node_type, name] = Node(node_type, name, topic, data_type, robot)


def _kind(management: dict[str, Any]) -> Kind:
    try:
        return Kind(management.get("message_manager"))
    except ValueError:
        return Kind.OTHER


def _object(raw: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _fits(value: object, kind: type, most: int) -> bool:
    return type(value) is kind and (not isinstance(value, int) or 0 <= value <= most)
