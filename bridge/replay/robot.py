"""A recorded robot on the mesh: online under its id and group, it offers its topics, takes registrations and puts what
was recorded, so that headsets, pages and agents need not know.

It does nothing: commands, services and actions are refused with the reason.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Awaitable, Callable
from contextlib import suppress

import msgspec

from bridge.replay.recorded import RecordedRobot, RecordedTopic
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Refused
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import type_number
from macs_zenoh.protocol.limits import CALL_BYTES
from macs_zenoh.protocol.messages import (
    ROS,
    AddNode,
    CallFailure,
    DataRefused,
    FunctionalityRequest,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    decode_data,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.offers import absolute, short_type
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.registrations import check_own
from macs_zenoh.protocol.robot_state import (
    STATUS,
    ControlReply,
    ControlRequest,
    NodeStatus,
    RobotStatus,
    StopStatus,
)
from macs_zenoh.protocol.schemas import DefinitionsReply, DefinitionsRequest, full_type, needs, unity_differs
from macs_zenoh.protocol.wire import Layout, encode_frame, encode_message
from macs_zenoh.serving import Call
from macs_zenoh.streams import Streams

log = logging.getLogger("macs.replay")

Registrant = tuple[int, int]
WHY_NOT = "this robot is a recording that is played: it does nothing"
REGISTRANTS = 1024
"""Of one topic."""


class _Node:
    """An interface node: who is registered on a topic."""

    def __init__(self, topic: RecordedTopic) -> None:
        self.topic = topic
        self.name = node_name(topic.name)
        self.registrants: frozenset[Registrant] = frozenset()


class ReplayedRobot:
    """Serves one recorded robot as ``agent``. `put` may be called in any thread, everything else on the loop."""

    def __init__(self, agent: Agent, recorded: RecordedRobot) -> None:
        self.agent = agent
        self.recorded = recorded
        self.refused = 0
        self._streams = Streams(agent)
        self._layout = Layout(agent.mesh.settings.id_slots, agent.mesh.settings.group_slots)
        self._nodes = {node_name(topic.name): _Node(topic) for topic in recorded.topics.values()}
        self._lock = threading.Lock()
        """Held while a message is put and while somebody registers, so that a latched one comes to each once."""

    def start(self) -> None:
        """Serve."""
        verbs: dict[str, Callable[[Call], Awaitable[bytes]]] = {
            "add_node": self._add_node,
            "remove_node": self._remove_node,
            "offers": self._offers,
            "definitions": self._definitions,
            "status": self._status,
            "control": self._control,
            "stop": self._stop,
        }
        for verb, handler in verbs.items():
            self.agent.serve(verb, handler, most_bytes=CALL_BYTES)
        self.agent.on_message(self._receive)
        self.agent.on_presence(self._presence)

    # -- what is played ------------------------------------------------------------------------------------------

    def put(self, topic: RecordedTopic, cdr: bytes) -> None:
        """A message of a topic is due."""
        node = self._nodes[node_name(topic.name)]
        with self._lock:
            if topic.is_latched:
                topic.last = cdr
            if node.registrants:
                self._put(node, cdr, node.registrants)

    def _put(self, node: _Node, cdr: bytes, receivers: frozenset[Registrant]) -> None:
        by_type: dict[str, list[int]] = {}
        for agent_type, agent_id in sorted(receivers):
            by_type.setdefault(str(agent_type), []).append(agent_id)
        metadata = Metadata(
            ROS,
            self.agent.id,
            message_manager=StreamData.manager,
            node_type=NodeType.SUBSCRIBER,
            node_name=node.name,
            data_exchange_type=short_type(node.topic.type),
        )
        frame = encode_frame(
            ROS,
            management=encode_management(StreamData(by_type)),
            message=encode_message(metadata.encode(), cdr),
            layout=self._layout,
        )
        with suppress(MacsError):  # a name that no key can have was refused when it was registered
            self._streams.publish(node.name, frame)

    # -- verbs ---------------------------------------------------------------------------------------------------

    async def _add_node(self, call: Call) -> bytes:
        request = decode_data(AddNode, call.data)
        sender = (type_number(call.sender_type), call.sender_id)
        check_own(request, sender)
        if request.node_type != NodeType.SUBSCRIBER:
            self.refused += 1
            raise Refused(WHY_NOT)
        topic = self.recorded.topics.get(absolute(request.tos_name))
        if topic is None or request.node_name != node_name(request.tos_name):
            raise Refused(f"{request.tos_name[:80]} is not in the recording that is played")
        if full_type(request.data_exchange_type) != topic.type:
            raise Refused(f"{topic.name} has type {topic.type} on this robot, not {request.data_exchange_type[:80]}")
        if request.unity_cdr is True and unity_differs(topic.type, self.recorded.definitions):
            raise Refused(f"a recording cannot be played to Unity's serializer where a type is like {topic.type}")
        node = self._nodes[node_name(topic.name)]
        if len(node.registrants) >= REGISTRANTS:
            raise Refused(f"{topic.name} has {REGISTRANTS} registrants, and takes no more")
        with self._lock:
            is_new = sender not in node.registrants
            node.registrants |= {sender}
            if is_new and topic.last is not None:
                self._put(node, topic.last, frozenset({sender}))
        return b""

    async def _remove_node(self, call: Call) -> bytes:
        request = decode_data(RemoveNode, call.data)
        sender = (type_number(call.sender_type), call.sender_id)
        check_own(request, sender)
        if request.node_type == NodeType.SUBSCRIBER and (node := self._nodes.get(request.node_name)) is not None:
            node.registrants -= {sender}
        return b""

    async def _offers(self, _call: Call) -> bytes:
        return encode_data(msgspec.structs.replace(self.recorded.offers(), replay=True))

    async def _definitions(self, call: Call) -> bytes:
        request = decode_data(DefinitionsRequest, call.data) if call.data else DefinitionsRequest()
        known = self.recorded.definitions
        waiting = [full_type(name) for name in request.types] or list(known)
        seen = set(waiting)
        for name in waiting:
            for needed in needs(name, known[name].text) if name in known else ():
                if needed not in seen:
                    seen.add(needed)
                    waiting.append(needed)
        found = {name: known[name] for name in waiting if name in known}
        missing = {name: "it is not in the recording that is played" for name in waiting if name not in known}
        return encode_data(DefinitionsReply(found, missing))

    async def _status(self, _call: Call) -> bytes:
        return self._state()

    def _state(self) -> bytes:
        nodes = [
            NodeStatus(
                "subscriber", node.topic.name, node.topic.type, [f"{t}/{i}" for t, i in sorted(node.registrants)]
            )
            for node in self._nodes.values()
            if node.registrants
        ]
        drops = {"refused_by_replay": self.refused} if self.refused else {}
        return msgspec.json.encode(RobotStatus("/replay", False, StopStatus(), nodes, drops))

    async def _control(self, call: Call) -> bytes:
        return encode_data(self._controlled(call.data))

    def _controlled(self, data: bytes) -> ControlReply:
        try:
            decode_data(ControlRequest, data)
        except MacsError as error:
            return ControlReply(False, reason=str(error))
        return ControlReply(False, reason=WHY_NOT)

    async def _stop(self, _call: Call) -> bytes:
        raise Refused(WHY_NOT)

    # -- messages ------------------------------------------------------------------------------------------------

    def _receive(self, message: Message) -> None:
        said = message.metadata
        sender = (type_number(message.sender_type), message.sender_id)
        if said.node_name:
            self._refuse(sender, message)
        elif said.message_manager == FunctionalityRequest.manager:
            self._answer(sender, said.request_id, encode_data(self.recorded.offers()))
        elif said.message_manager == STATUS:
            self._answer(sender, said.request_id, self._state())
        elif said.message_manager == ControlRequest.manager:
            self._answer(sender, said.request_id, encode_data(self._controlled(message.data)))

    def _refuse(self, sender: Registrant, message: Message) -> None:
        """Commands, calls and goals: whoever understands it hears why."""
        said = message.metadata
        self.refused += 1
        if said.node_type == NodeType.CLIENT and said.message_manager == CallFailure.manager:
            failure = CallFailure("refused", WHY_NOT)
            answer = msgspec.structs.replace(
                said, sender_agent_type=ROS, sender_agent_id=self.agent.id, message_manager=CallFailure.manager
            )
            self._send(sender, answer, encode_data(failure))
            return
        if said.node_type != NodeType.PUBLISHER:
            return
        refused = DataRefused(self.agent.id, said.node_type, said.node_name, "", "not_allowed", WHY_NOT)
        self._send(sender, Metadata(ROS, self.agent.id, message_manager=DataRefused.manager), encode_data(refused))

    def _answer(self, to: Registrant, request_id: int, data: bytes) -> None:
        self._send(to, Metadata(request_id=request_id), data)

    def _send(self, to: Registrant, metadata: Metadata, data: bytes) -> None:
        try:
            self.agent.send(data, to=to[0], ids=[to[1]], metadata=metadata)
        except MacsError as error:
            log.debug("an answer to %s is lost: %s", to, error)

    def _presence(self, agent: AgentInfo, online: bool) -> None:
        if not online:
            for node in self._nodes.values():
                node.registrants -= {(agent.type, agent.id)}
