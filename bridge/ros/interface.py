"""What all interface nodes have in common: names, registrants, and the robot they work for."""

from __future__ import annotations

import asyncio
import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from bridge.audit import NO_AUDIT, Audit
from bridge.ros.alarms import Alarms
from bridge.ros.early import NodeKey
from bridge.ros.refusals import Refusals
from bridge.ros.rules import Rules
from bridge.ros.safety import EmergencyStop, Trips
from bridge.ros.side import Side
from bridge.ros.types import InterfaceName
from macs_zenoh.config import Priority
from macs_zenoh.errors import HeldByAnother, Refused
from macs_zenoh.losses import Losses
from macs_zenoh.mesh import Tracing
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.keyexpr import type_name, type_number
from macs_zenoh.protocol.messages import ROS, AddNode, Metadata, NodeType, RemoveNode, encode_data
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import NodeStatus
from macs_zenoh.protocol.wire import MACS, Layout

log = logging.getLogger("macs.ros")

PublishStream = Callable[[str, bytes], None]
"""Node name and whole frame; from any thread."""
SendTo = Callable[["Registrant", Metadata, bytes], None]
"""To one agent, on the loop."""


class Registrant(AgentId):
    """An agent that registered an interface node."""

    __slots__ = ()

    @classmethod
    def of(cls, message: Message) -> Registrant:
        """The sender of a message."""
        return cls(type_number(message.sender_type), message.sender_id)


class Drops(Losses):
    """What was lost, by name.

    ``no_node`` data for a node that is not registered; ``held_full`` data before its registration, more than is kept;
    ``bad_cdr`` data that cannot be a ROS message; ``lost_in_ros`` messages that ROS lost before we could take them;
    ``failed`` messages that ROS or the mesh did not take; ``late_answer`` answers after their deadline, or to nothing;
    ``refused_by_manager`` management messages that an own manager did not take; ``not_in_control`` and ``stopped``
    commands that safety did not let pass; ``bad_request`` what asks for nothing that there is; ``bad_stop_state`` what
    another agent of the ROS graph says of the emergency stop, and cannot be read; ``flooded`` what one agent sends
    above its allowance; ``too_old`` commands that have waited on their way.
    """

    def __init__(self) -> None:
        super().__init__(log)


@dataclass(eq=False)
class Robot:
    """What interface nodes work with.

    Attributes:
        session: the ROS graph, and our node in it.
        agent_id: the robot's id on the mesh now.
        publish_stream: puts a frame on the mesh.
        tell_stream: puts one that is no topic data beside it.
        prioritise_stream: sets the priority of a node's frames; None: the usual one.
        keep_stream: sets how many of a node's frames are kept for recovery; None: as the traffic rules say. Returns
            whether any are.
        layout: of the mesh's frames.
        send: a message to one agent.
        rules: what the settings say by name.
        group_of: an agent's group now as far as rights go, 0 for none.
        is_online: whether an agent has been seen: what it sends can come before its presence, on which its rights
            may depend.
        stop: the emergency stop.
        trips: which dead-men have acted.
        no_stop: why there is none, though the settings want one. Until there is, nobody acts on the robot.
        alarms: calls back at a time, whatever the loop is busy with.
        refusals: who was told lately why what he sent was not taken.
        audit: the record of who did what.
        tracing: what is noted of messages that are traced.
    """

    session: Side
    agent_id: int
    publish_stream: PublishStream
    layout: Layout = MACS
    drops: Drops = field(default_factory=Drops)
    send: SendTo = lambda to, metadata, data: None
    rules: Rules = field(default_factory=Rules)
    group_of: Callable[[Registrant], int] = lambda agent: 0
    is_online: Callable[[Registrant], bool] = lambda agent: True
    stop: EmergencyStop = field(default_factory=EmergencyStop)
    trips: Trips = field(default_factory=Trips)
    no_stop: str = ""
    tell_stream: PublishStream = lambda node, frame: None
    prioritise_stream: Callable[[str, Priority | None], None] = lambda node, priority: None
    keep_stream: Callable[[str, int | None], bool] = lambda node, frames: False
    alarms: Alarms = field(default_factory=Alarms)
    refusals: Refusals = field(default_factory=Refusals)
    audit: Audit = NO_AUDIT
    tracing: Tracing | None = None
    made: dict[str, str] = field(default_factory=dict)
    """Topics that our own node publishes for others, with their types."""

    def tell_refused(self, message: Message, topic: str, kind: str, reason: str) -> None:
        """Tell a message's sender why it was not taken; ``kind`` is the name under which that is counted."""
        told = self.refusals.due(message, self.agent_id, topic, kind, reason)
        if told is not None:
            metadata = Metadata(ROS, self.agent_id, message_manager=told.manager)
            self.send(Registrant.of(message), metadata, encode_data(told))


class InterfaceNode(ABC):
    """One interface node: its registrants, and what it has on the ROS graph between `open` and `close`."""

    NODE_TYPE: ClassVar[NodeType]
    ROLE: ClassVar[str]
    INTERFACE: ClassVar[str] = "msg"
    """Kind of its ROS interface."""
    MAX_REGISTRANTS: ClassVar[int | None] = None

    def __init__(self, robot: Robot, request: AddNode) -> None:
        """Check the names. Raises Refused."""
        self.robot = robot
        self.key = key_of(request)
        self.request = request
        self.topic = self.full_name(request.tos_name)
        self.interface = InterfaceName.parse(request.data_exchange_type, self.INTERFACE)
        self.registrants: set[Registrant] = set()
        self.unity: set[Registrant] = set()
        """Those of them that write and read CDR as Unity's serializer does (`unity_cdr`)."""
        self.linger_s = 0.0
        """How long an agent stays registered that is not seen on the mesh any more."""
        self.told_types: set[str] = set()
        """What its registrants were told last of the types that others use under this name."""
        self.is_open = False
        self.alike = False
        """Whether the robot knows another topic with the same node name."""
        self.opening: asyncio.Task[None] | None = None
        self.unused: Callable[[], None] = lambda: None
        """Called when a node that was in use without registrants is not any more."""
        if not _NODE_NAME.fullmatch(request.node_name):
            raise Refused(f"{request.node_name[:80]!r} is not a valid node name")
        robot.rules.check_exposed(self.topic)
        self.rule = robot.rules.of(self.topic)

    def full_name(self, name: str) -> str:
        """A topic's or service's name, expanded and remapped for our node. Raises Refused when it is invalid."""
        return full_name(self.robot, type(self), name)

    @classmethod
    def resolve(cls, side: Side, name: str) -> str:
        """The same, for what this node makes."""
        return side.service_name(name) if cls.INTERFACE == "srv" else side.topic_name(name)

    def known_names(self) -> list[str]:
        """Names of all that ROS has of what this node works on. In the ROS thread."""
        side = self.robot.session
        return [name for name, _ in (side.services() if self.INTERFACE == "srv" else side.topics())]

    @property
    def held(self) -> bool:
        """Whether the emergency stop, or that there is none, keeps agents from acting through this node now."""
        held = self.robot.stop.stopped or bool(self.robot.no_stop)
        return held and not self.rule.allow_while_stopped

    def held_since(self, stops: int) -> bool:
        """The same, or whether it did meanwhile: ``stops`` is how often there had been one."""
        stop = self.robot.stop
        return self.held or (stop.times != stops and not self.rule.allow_while_stopped)

    def stop_reason(self) -> str:
        """Why nothing is done that waited."""
        stop = self.robot.stop
        if self.robot.no_stop:
            return self.robot.no_stop
        return f"the emergency stop by {stop.by} holds" if stop.stopped else "the robot was stopped meanwhile"

    @property
    def in_use(self) -> bool:
        """Whether the node must stay: somebody is registered, or waits for something."""
        return bool(self.registrants)

    def check_same(self, request: AddNode) -> None:
        """Raise Refused when another topic or type is wanted under this node's name."""
        topic = self.full_name(request.tos_name)
        if topic != self.topic:
            raise self.collision(topic, request.node_name)
        interface = InterfaceName.parse(request.data_exchange_type, self.INTERFACE)
        if interface != self.interface:
            raise Refused(f"{topic} is registered with type {self.interface}, not {interface}")

    def collision(self, topic: str, node_name: str) -> Refused:
        """The refusal of another topic whose messages could not be told from those of this node."""
        return Refused(f"{topic} and {self.topic} have the same node name {node_name}; use one of them")

    def other_types(self) -> set[str]:
        """The types that others on the robot use under this name, when none of them uses ours. In the ROS thread."""
        return set()

    def register(self, registrant: Registrant, *, unity: bool = False) -> None:
        """Add a registrant; twice changes nothing. Raises Refused when the node takes no more."""
        if registrant in self.registrants and unity is (registrant in self.unity):
            return
        others = self.registrants - {registrant}
        if self.MAX_REGISTRANTS is not None and len(others) >= self.MAX_REGISTRANTS:
            reason = f"{self.topic} is already registered by another agent, and {self.ROLE} has only one"
            raise HeldByAnother(reason, next(iter(others)))
        self.registrants.add(registrant)
        (self.unity.add if unity else self.unity.discard)(registrant)
        self.registrants_changed()

    def deregister(self, registrant: Registrant) -> None:
        """Take a registrant off, if it is there."""
        if registrant in self.registrants:
            self.registrants.remove(registrant)
            self.unity.discard(registrant)
            self.registrants_changed()

    def registrants_changed(self) -> None:  # noqa: B027 - only some nodes care
        """Somebody registered or left."""

    def welcome(self, registrant: Registrant) -> None:  # noqa: B027 - only some nodes have something for it
        """Somebody registered, and the entity is there. On the loop."""

    @abstractmethod
    def open(self) -> None:
        """Have it on the ROS graph. In the ROS thread. Raises Refused."""

    async def settle(self) -> None:  # noqa: B027 - only some nodes have to wait
        """Wait, on the loop and not for long, until the entity can do its work."""

    @abstractmethod
    def close(self) -> None:
        """Have it there no more. In the ROS thread."""

    @abstractmethod
    def receive(self, message: Message) -> None:
        """Take a message that names this node. On the loop; commands (type 2) from any thread."""

    def refused(self, message: Message, reason: str) -> None:  # noqa: B027 - only some senders wait for an answer
        """A message of somebody who may not send it came; tell its sender, where that is possible. On the loop."""

    def left(self, agent: Registrant) -> None:  # noqa: B027 - only some nodes care
        """An agent left the mesh, registered here or not. On the loop."""

    def fell_asleep(self, agent: Registrant) -> None:  # noqa: B027 - only some nodes move the robot
        """The connection of an agent has ended, and it may come back as the same one. On the loop."""

    def stays_asleep(self, agent: Registrant) -> None:  # noqa: B027 - only who waits for it cares
        """It has not come back for longer than others should wait for it. On the loop."""

    def returned(self, agent: Registrant) -> None:  # noqa: B027 - only some nodes care
        """An agent that left is there again, and nobody had its id meanwhile. On the loop."""

    def cut_off(self) -> None:  # noqa: B027 - only some nodes care
        """The robot has lost the mesh. On the loop."""

    def tell_count(self, registrant: Registrant, *, again: bool) -> None:  # noqa: B027 - only some nodes count
        """A registrant wants to know how much was put for it; ``again``: also what it was told before. On the loop."""

    def emergency_stop(self, by: str) -> None:  # noqa: B027 - only some nodes move the robot
        """Somebody stopped the robot. In any thread, and soon."""

    def retire(self) -> None:  # noqa: B027 - only some nodes have something open
        """The node will be closed: end what is open. On the loop, before `close`."""

    def tell_registrants(self, kind: str, reason: str) -> None:
        """Tell registrants that know our extensions what is wrong with this node; not often. On the loop."""
        for registrant in self.registrants:
            about = Metadata(*registrant, node_type=self.key.node_type, node_name=self.key.node_name)
            message = Message(type_name(registrant.type), registrant.id, about, b"")
            self.robot.tell_refused(message, self.topic, kind, reason)

    def metadata(self, manager: str = "", request_id: int = 0) -> Metadata:
        """Of a message from this node."""
        return Metadata(
            sender_agent_type=ROS,
            sender_agent_id=self.robot.agent_id,
            request_id=request_id,
            message_manager=manager,
            node_type=self.NODE_TYPE,
            node_name=self.key.node_name,
            data_exchange_type=self.interface.short,
        )

    def status(self) -> NodeStatus:
        """What there is to see from outside."""
        registrants = [str(registrant) for registrant in sorted(self.registrants)]
        return NodeStatus(self.ROLE, self.topic, str(self.interface), registrants)


_NODE_NAME = re.compile(r"[A-Za-z0-9_]{1,260}")


def full_name(robot: Robot, kind: type[InterfaceNode], name: str) -> str:
    """What a name from the network means on this robot: what rules, control and nodes go by. Raises Refused."""
    return kind.resolve(robot.session, name)


def key_of(request: AddNode | RemoveNode) -> NodeKey:
    """The interface node that a registration is about."""
    return NodeKey(request.node_type, request.node_name)
