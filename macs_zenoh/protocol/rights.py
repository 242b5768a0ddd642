"""What a token lets its agent do, asked of each frame where that enters. Pure.

Rights name what an agent does, as it names it: robots by id, groups, topics by pattern, and the kind of what it sends.
What they do not name is refused. An agent without a token that came where none is wanted has no `Rights`: nothing is
asked of it then, so that its frames cost nothing more.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated, Literal, NamedTuple, get_args

from msgspec import Meta, Struct, field

from .credit import Credit
from .guard import STOP_TOPIC
from .messages import (
    EVERYBODY,
    MANAGERS,
    ROS,
    UNITY,
    AddNode,
    CommandClock,
    FunctionalityRequest,
    Metadata,
    NodeType,
    RemoveNode,
    node_name,
)
from .name_patterns import NamePattern, matches
from .wire import Header

Right = Literal["see", "command", "call", "serve", "act", "stop", "ask", "send", "broadcast", "record", "robot"]

RIGHTS: dict[Right, str] = {
    "see": "register for topics that robots send, ask what they offer and how they are",
    "command": "publish to topics of robots, take control of them",
    "call": "call services of robots",
    "serve": "answer service calls that robots make",
    "act": "give goals to actions of robots",
    "stop": "press and release emergency stops; a robot has its own say in who releases",
    "ask": "ask own managers of robots and gateways, send robots what belongs to no topic",
    "send": "send to other headsets by id and by group",
    "broadcast": "send to everybody, what needs no other right; only with --robots any, for robots hear it as well",
    "record": "record the mesh at the web port, and have what was recorded; only with --robots any and all topics",
    "robot": "join as a robot program, and not as a headset",
}
"""Each right by its name, with what it permits."""

ANY: Literal["any"] = "any"

_OF_NODES: dict[int, Right] = {
    NodeType.SUBSCRIBER: "see",
    NodeType.PUBLISHER: "command",
    NodeType.CLIENT: "call",
    NodeType.SERVICE: "serve",
    NodeType.ACTION: "act",
}
_OF_REQUESTS: dict[str, Right] = {
    FunctionalityRequest.manager: "see",
    "RobotStatus": "see",
    "RobotControl": "command",
    CommandClock.manager: "command",
}
"""Requests to robots that are no own managers' (docs/robot.md)."""

EVERY_NAME = "/**"

_PLAIN_NAME = re.compile(r"(/[A-Za-z_]\w*)+", re.ASCII)
"""A name that means the same on each robot: not relative, private or with something to be put in."""

RobotId = Annotated[int, Meta(ge=1, le=0xFFFF)]
GroupId = Annotated[int, Meta(ge=1, le=0xFF)]


class Rights(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one token permits."""

    may: list[Right] = []
    robots: list[RobotId] | Literal["any"] = []
    """Robots that it may name by id."""
    groups: list[GroupId] | Literal["any"] = []
    """Groups that it may name, of robots and of headsets, and be in."""
    topics: list[NamePattern] = field(default_factory=lambda: [EVERY_NAME])
    """Topics, services and actions; a stop needs none of these."""
    stop_topics: list[NamePattern] = field(default_factory=lambda: [STOP_TOPIC])
    """Topics on which robots expect a stop: to publish there takes the right to stop, and no other."""
    frames_per_s: Annotated[float, Meta(ge=0, le=1_000_000)] = 0.0
    """Of all connections with this token at one gateway together; 0: no limit."""

    def __post_init__(self) -> None:
        if "broadcast" in self.may and self.robots != ANY:
            raise ValueError("everybody hears a broadcast, all robots too: it needs --robots any")
        if "record" in self.may and (self.robots != ANY or EVERY_NAME not in self.topics):
            raise ValueError("recordings have every robot and topic: to record needs --robots any and all topics")

    def has(self, right: Right) -> bool:
        """Whether it is among them."""
        return right in self.may

    def may_be_in(self, group: int) -> bool:
        """Whether its agent may be in a group; 0 is none."""
        return group == 0 or self.groups == ANY or group in self.groups

    def sees(self, robot: int, group: int) -> bool:
        """Whether it may know that a robot of this group is online: one that it can name, by id or by group."""
        if self.robots == ANY or robot in self.robots:
            return True
        return group != 0 and (self.groups == ANY or group in self.groups)

    def of_registration(self, node: AddNode | RemoveNode, robots: Iterable[int], groups: Iterable[int]) -> str | None:
        """Why an agent may not register on, or leave, a node of these robots and groups of robots; None: it may."""
        why = self._named(ROS, robots, groups)
        if why is None and isinstance(node, AddNode):
            why = self._of_node(node.node_type, node.tos_name)
        return why

    def of_frame(self, header: Header, metadata: Metadata, name: str | None) -> str | None:
        """Why a frame for others may not go on; None: it may. ``name`` is that of the topic, service or action that
        the agent registered under the frame's node name, None when it registered none."""
        if header.agent_type not in (EVERYBODY, ROS, UNITY):
            return f"there are no agents of type {header.agent_type} to send to"
        if header.agent_type == EVERYBODY and not self.has("broadcast"):
            return _missing("broadcast")
        why = None if header.agent_type == EVERYBODY else self._named(header.agent_type, header.ids, header.groups)
        if why is None and header.agent_type == UNITY:
            why = self._to_headsets(metadata)
        elif why is None and metadata.node_name:
            why = self._of_node_data(metadata, name)
        elif why is None and (header.agent_type == ROS or metadata.message_manager):
            why = self._of_request(metadata.message_manager)
        return why

    # -- pieces --------------------------------------------------------------------------------------------------

    def of_topic(self, name: str) -> str | None:
        """Why an agent may not see a topic, on any robot; None: it may."""
        return self._of_node(int(NodeType.SUBSCRIBER), name)

    def _named(self, agent_type: int, ids: Iterable[int], groups: Iterable[int]) -> str | None:
        if agent_type == ROS and self.robots != ANY:
            for robot in ids:
                if robot not in self.robots:
                    return f"robot {robot} is not among the robots of this token"
        if self.groups != ANY:
            for group in groups:
                if group not in self.groups:
                    return f"group {group} is not among the groups of this token"
        return None

    def _of_node(self, node_type: int, name: str) -> str | None:
        """A node of robots, by its type and by the name of its topic, service or action."""
        right = _OF_NODES.get(node_type)
        if right is None:
            return f"there are no nodes of type {node_type}"
        if right == "command" and self.is_stop(name):
            return None if self.has("stop") else _missing("stop")
        if not self.has(right):
            return _missing(right)
        if "{" in name:  # ROS puts something in there, which may make another name of it
            return f"{name[:80]!r} is no name that a token can be for"
        if EVERY_NAME in self.topics:
            return None
        if not _PLAIN_NAME.fullmatch(name):
            return f"{name[:80]!r} is no full name, as /camera/image, which this token is for"
        if not any(matches(pattern, name) for pattern in self.topics):
            return f"{name[:80]} is not among the topics of this token"
        return None

    def is_stop(self, name: str) -> bool:
        """Whether robots may take it for their stop: by its node name, for that is all that messages say."""
        own = node_name(name if name.startswith("/") else f"/{name}")
        return any(own == node_name(stop) for stop in self.stop_topics)

    def _of_node_data(self, metadata: Metadata, name: str | None) -> str | None:
        """Data for a node of robots: what its registration needed, which therefore has to come first."""
        if name is None:
            return "this node is not registered here, or its registration was refused"
        return self._of_node(metadata.node_type, name)

    def _of_request(self, manager: str) -> str | None:
        if manager in MANAGERS and manager not in _OF_REQUESTS:
            return f"{manager} is not for an agent to send"
        right = _OF_REQUESTS.get(manager, "ask")
        return None if self.has(right) else _missing(right)

    def _to_headsets(self, metadata: Metadata) -> str | None:
        if self.has("robot") and metadata.node_name:
            return None  # a robot program answers who called, and a gateway judges whether it was asked
        return None if self.has("send") else _missing("send")


def _missing(right: Right) -> str:
    return f"this token does not give the right to {right}"


class Grant(NamedTuple):
    """What somebody who was let in has."""

    name: str = ""
    """Of the token, for the log; empty without one."""
    rights: Rights | None = None
    """None: nothing is asked of it."""
    credit: Credit | None = None
    """What all who have the same token may send; None: no limit."""


OPEN = Grant()
"""Of who needs no token."""

assert set(RIGHTS) == set(get_args(Right))
