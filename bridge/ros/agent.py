"""The robot agent: an agent of type ``ros`` on the mesh that serves registrations of interface nodes.

Verbs: ``add_node`` (data: AddNode) and ``remove_node`` (RemoveNode), answered with nothing or a refusal that says why;
``offers`` (no data), answered with `robot_state.Offered`; ``definitions`` (`DefinitionsRequest`), with the texts of
types; ``status`` (no data, or `StatusRequest`), ``control`` (`ControlRequest`) and ``stop`` (``true`` or ``false``),
answered with JSON; ``trace``, see `traced`. See docs/robot.md.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from typing import TypeVar

from bridge.audit import open_audit, who
from bridge.ros import counts
from bridge.ros.checked import CheckedSettings
from bridge.ros.command_clocks import ClockQuestions
from bridge.ros.definitions import Definitions, Telling, offered_types
from bridge.ros.graph import Offers
from bridge.ros.interface import Registrant, Robot
from bridge.ros.mirrors import Mirrors
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.requests import Told, control, status
from bridge.ros.rules import Rules
from bridge.ros.safety import EmergencyStop
from bridge.ros.side import NamesAndTypes, Side
from bridge.ros.sleepers import stop_sleepers
from bridge.ros.stop_line import StopLine
from bridge.ros.traced import telling
from bridge.settings import RobotSettings
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Refused, WireError
from macs_zenoh.handles import Handle
from macs_zenoh.managers import Asker, Managers
from macs_zenoh.mesh import Mesh, now_s
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.guard import Guard
from macs_zenoh.protocol.keyexpr import type_name, type_number
from macs_zenoh.protocol.limits import CALL_BYTES
from macs_zenoh.protocol.messages import (
    AddNode,
    CommandClock,
    FunctionalityRequest,
    Metadata,
    RemoveNode,
    decode_data,
    encode_data,
)
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.registrations import check_own
from macs_zenoh.protocol.robot_state import STATUS, ControlReply, ControlRequest, released
from macs_zenoh.protocol.schemas import DefinitionsRequest
from macs_zenoh.protocol.wire import Layout
from macs_zenoh.serving import Call
from macs_zenoh.streams import Streams

log = logging.getLogger("macs.ros")

_Registration = TypeVar("_Registration", AddNode, RemoveNode)

REQUESTS = frozenset({FunctionalityRequest.manager, STATUS, ControlRequest.manager})
"""Managers of plain messages that a robot answers."""
ABSENT_S = 5.0
"""How long an agent may be registered without being online: its registration can come before its presence, and also
after its end, when it left in that moment."""
JUDGED_S = 1.0
"""How long the registration of an agent that is not seen yet waits for its presence, where that decides."""
SESSIONS = 8192
"""Of so many agents the robot remembers who had their ids last."""
NO_STOP = "this robot has no emergency stop yet, and nobody can act on it until it has"
STOP_AGAIN_S = 2.0
"""Pause between attempts to have an emergency stop, where its topic has another type."""
STOP_MESSAGES_S = 0.1
"""How long ROS nodes get, at the end, to take the last messages: what a writer that ends has sent is lost unread."""


class RobotAgent:
    """Connects an agent on the mesh with a ROS session. Made by `joined.joined`."""

    def __init__(
        self,
        agent: Agent,
        session: Side,
        settings: RobotSettings,
        managers: Managers | None = None,
        guard: Guard | None = None,
        emergency_stop: EmergencyStop | None = None,
    ) -> None:
        self._managers = managers or {}
        self._guard = guard
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        self.agent = agent
        self.session = session
        self.streams = Streams(agent)
        robot = Robot(
            session,
            agent.id,
            self.streams.publish,
            Layout(agent.mesh.settings.id_slots, agent.mesh.settings.group_slots),
            send=self._send,
            rules=Rules(settings),
            stop=emergency_stop or EmergencyStop(),
            group_of=self._group_of,
            is_online=lambda agent: agent in self.agent.directory,
            tell_stream=self.streams.tell,
            prioritise_stream=self.streams.prioritise,
            keep_stream=self.streams.keep,
            tracing=agent.mesh.tracing,
        )
        self._audit = robot.audit = open_audit(
            settings.audit_file,
            f"robot {agent.id}",
            settings.audit_max_bytes,
            settings.audit_files,
            lambda name: robot.drops.note(name, "", "the record of who did what is not whole"),
        )
        self.nodes = InterfaceNodes(robot, max_nodes=settings.max_nodes)
        self.checked = CheckedSettings(session, robot.rules, robot.drops)
        self.offers = Offers(robot, self.streams.publish, self._graph_changed)
        self._definitions = Telling(Definitions(session.definition))
        self._clocks = ClockQuestions(robot, guard, self.nodes.rights.check)
        self._answering: dict[asyncio.Task[None], Registrant] = {}
        self._sessions: dict[Registrant, tuple[str, int]] = {}
        """Who has an id, or had it last."""
        self.stop_line: StopLine | None = None
        self._stop_later: asyncio.Task[None] | None = None
        self._last_words: Handle | None = None
        self._told = Told(
            lambda: status(self.nodes, session.full_name, agent.drops + agent.mesh.drops, counts=guard is not None)
        )
        self._mirrors: Mirrors | None = None

    def _graph_changed(self, topics: NamesAndTypes, services: NamesAndTypes) -> None:
        """In the ROS thread."""
        self.checked.look(topics, services)
        self.nodes.look_at_types(topics, services)

    async def start(self) -> None:
        """Serve from now on."""
        settings = self.nodes.robot.rules.settings
        if settings.stop_topic:
            self.nodes.robot.no_stop = NO_STOP
        if settings.stop_topic and not await self._open_stop(settings.stop_topic, logging.ERROR):
            self._stop_later = asyncio.create_task(self._until_stop(settings.stop_topic))
        self.agent.on_presence(self._presence)
        stop_sleepers(self.agent, self.nodes)
        self.agent.on_id(self._id_changed)
        self.agent.mesh.on_link(self._link)
        self._last_words = self.agent.mesh.last_words(self.nodes.last_words)
        self.agent.mesh.tells = self._troubles
        for verb, handler in (
            ("add_node", self._add_node),
            ("remove_node", self._remove_node),
            ("offers", self._offers),
            ("definitions", self._tell_definitions),
            ("status", counts.telling(self.nodes, self.state)),
            ("control", self._control),
            ("trace", telling(self.agent)),
        ):
            self.agent.serve(verb, handler, most_bytes=CALL_BYTES)
        self.agent.serve("stop", self._stopped, first=self._stop, stand_in=True)
        self.agent.on_message(self._receive)
        if settings.mirror:
            self._mirrors = Mirrors(self.nodes.robot, self.agent)
        self._let_stop()
        if self._guard is not None:
            self._guard.on_dropped = self.nodes.drops.note
            self._guard.on_missing = self.agent.mesh.drops.note
            self._guard.on_command = self.nodes.deliver

    async def _open_stop(self, topic: str, level: int) -> bool:
        try:
            await self.nodes.open_stop(topic)
        except Refused as refusal:
            self.nodes.robot.no_stop = f"{NO_STOP}: {refusal.reason}"
            log.log(level, "there is no emergency stop, and nobody can act on this robot: %s", refusal.reason)
            return False
        self.nodes.robot.no_stop = ""
        return True

    async def _until_stop(self, topic: str) -> None:
        """What has another type on its topic may end."""
        while True:
            await asyncio.sleep(STOP_AGAIN_S)
            if await self._open_stop(topic, logging.DEBUG):
                break
        log.warning("there is an emergency stop now, %s", topic)
        self._let_stop()

    def _let_stop(self) -> None:
        """Whoever stops is listened to by all ways, once there is an emergency stop."""
        stop, guard = self.nodes.stop, self._guard
        if stop is None:
            return
        if self.agent.mesh.settings.mode == "client":
            self.stop_line = StopLine(self.agent.mesh.settings, self._serve_stop)
        if guard is not None:
            stop.overtaken = lambda message: guard.overtaken(message, now_s())
            guard.stop_name = stop.key.node_name

    def _receive(self, message: Message) -> None:
        try:
            if message.metadata.node_name:
                self.nodes.deliver(message)
            elif message.metadata.message_manager == CommandClock.manager:
                self._clocks.take(message)
            elif message.metadata.message_manager in self._managers:
                self._manage(message)
            elif message.metadata.message_manager in REQUESTS and self.agent.mesh.backlogged:
                self.nodes.drops.note(
                    "flooded", str(Registrant.of(message)), "answers that nobody takes fill the link"
                )
            elif message.metadata.message_manager in REQUESTS:
                # an answer may take a while; an emergency stop behind it must not wait
                self._answering[answer := asyncio.create_task(self._answer(message))] = Registrant.of(message)
                answer.add_done_callback(self._answering.pop)
        except Exception:
            # a message that hits a fault of ours must not make the robot deaf for all that follow
            log.exception("a message from %s/%d failed", message.sender_type, message.sender_id)

    async def close(self) -> None:
        """End everything that is open."""
        if self._guard is not None:
            self._guard.on_command = _ignore
        self.agent.on_message(_ignore)
        self.nodes.close()  # before all that may fail: what moves is stopped here
        self.offers.close()
        self._clocks.close()
        if self._mirrors is not None:
            self._mirrors.close()
        if self._stop_later is not None:
            self._stop_later.cancel()
        for answer in self._answering:
            answer.cancel()
        if self._last_words is not None:
            self._last_words.close()
        if self.stop_line is not None:
            await self.stop_line.close()
        await asyncio.to_thread(self._audit.close)

    # -- plain requests ------------------------------------------------------------------------------------------

    async def _answer(self, message: Message) -> None:
        """Answer a message that names no interface node."""
        sender, manager = Registrant.of(message), message.metadata.message_manager
        if manager == FunctionalityRequest.manager:
            data = encode_data(await self.offers.now())
            self.offers.follow(sender, message)
        elif manager == STATUS:
            data = self.state()
        else:
            data = encode_data(self._controlled(sender, message.data))
        self._send(sender, Metadata(request_id=message.metadata.request_id), data)

    def _manage(self, message: Message) -> None:
        """A management message for a manager that somebody added."""
        sender, name = Registrant.of(message), message.metadata.message_manager
        manager = self._managers[name]
        try:
            data = decode_data(manager.Data, message.data)
            answer = manager.manage(data, Asker(*sender, self._group_of(sender)))
        except (Refused, WireError) as error:
            self.nodes.drops.note("refused_by_manager", f"{name} for {sender}", str(error))
            return
        if answer is not None:
            self._send(sender, Metadata(request_id=message.metadata.request_id), encode_data(answer))

    def _troubles(self) -> dict[str, int]:
        """What `macs doctor` shall find."""
        troubles = {"wrong_settings": len(self.checked.wrong)}
        if self.nodes.stop is None:
            troubles["no_stop"] = int(bool(self.nodes.robot.rules.settings.stop_topic))
        else:
            troubles["shared_graph"] = len(self.nodes.stop.shared_with)
        return {name: count for name, count in (troubles | self._audit.troubles()).items() if count}

    def state(self) -> bytes:
        """All about the robot as JSON (`RobotStatus`)."""
        return self._told.now(time.monotonic())

    def _controlled(self, sender: Registrant, data: bytes) -> ControlReply:
        try:
            request = decode_data(ControlRequest, data)
            return control(self.nodes, sender, request, asyncio.get_running_loop().time())
        except (Refused, WireError) as error:
            return ControlReply(False, reason=str(error))

    # -- verbs ---------------------------------------------------------------------------------------------------

    async def _add_node(self, call: Call) -> bytes:
        request = _own(decode_data(AddNode, call.data), call)
        registrant = Registrant(request.registrant_agent_type, request.registrant_agent_id)
        await self._until_judged(registrant)
        what = f"type {request.node_type} {request.tos_name}"
        try:
            await self.nodes.add(request)
        except Refused as refusal:
            self._audit.record("register", who(str(registrant)), what, refusal.reason)
            raise
        self._audit.record("register", who(str(registrant)), what)
        if registrant not in self.agent.directory:
            asyncio.get_running_loop().call_later(ABSENT_S, self._forget_absent, registrant)
        return b""

    async def _until_judged(self, registrant: Registrant) -> None:
        """A registration can come before the presence of its agent, on whose group its rights may depend."""
        deadline = time.monotonic() + JUDGED_S
        may_act = self.nodes.rights.may_act
        while registrant not in self.agent.directory and time.monotonic() < deadline:
            if may_act(type_name(registrant.type), registrant.id):
                return
            await asyncio.sleep(0.02)

    def _forget_absent(self, registrant: Registrant) -> None:
        """Nobody would ever see it leave."""
        if registrant not in self.agent.directory:
            self.nodes.forget(registrant)

    async def _remove_node(self, call: Call) -> bytes:
        request = _own(decode_data(RemoveNode, call.data), call)
        self.nodes.remove(request)
        registrant = Registrant(request.registrant_agent_type, request.registrant_agent_id)
        self._audit.record("deregister", who(str(registrant)), f"type {request.node_type} {request.node_name}")
        return b""

    async def _offers(self, _call: Call) -> bytes:
        return encode_data(await self.offers.now())

    async def _tell_definitions(self, call: Call) -> bytes:
        request = decode_data(DefinitionsRequest, call.data) if call.data else DefinitionsRequest()
        types = request.types or offered_types(await self.offers.now())
        return encode_data(await self._definitions.tell((call.sender_type, call.sender_id), types))

    async def _control(self, call: Call) -> bytes:
        return encode_data(self._controlled(Registrant(type_number(call.sender_type), call.sender_id), call.data))

    def _serve_stop(self, mesh: Mesh) -> Handle:
        return self.agent.serve("stop", self._stopped, first=self._stop, mesh=mesh)

    def _stop(self, call: Call) -> None:
        """The emergency stop with an answer: data ``true``, ``false`` or a `release`. In a thread of Zenoh's."""
        stop, topic = self.nodes.stop, call.metadata.node_name
        sender = Registrant(type_number(call.sender_type), call.sender_id)
        if stop is None:
            raise Refused(self.nodes.robot.no_stop or "this robot has no emergency stop")
        if topic and topic != stop.key.node_name:  # a gateway asks, as what a headset sent may be a stop
            raise Refused(f"{topic[:80]} is not the emergency stop of this robot, which is {stop.topic}")
        releases, seen = released(call.data)
        if not releases and self._guard is not None:
            # before it stops: a release that is on its way must not come between the two
            self._guard.pressed(sender, now_s())
        stop.set(sender, not releases, seen=seen)

    async def _stopped(self, _call: Call) -> bytes:
        return self.state()

    # -- the mesh ------------------------------------------------------------------------------------------------

    def _send(self, to: Registrant, metadata: Metadata, data: bytes) -> None:
        """From any thread; those of Zenoh and of the ROS graph must not wait for a full link."""
        if threading.get_ident() != self._loop_thread:
            self._loop.call_soon_threadsafe(self._send, to, metadata, data)
            return
        try:
            self.agent.send(data, to=type_name(to.type), ids=[to.id], metadata=metadata)
        except MacsError as error:
            self.nodes.drops.note("failed", str(to), str(error))

    def _group_of(self, agent: Registrant) -> int:
        """As far as rights go. Agents choose their groups, so only some are believed."""
        found = self.agent.directory.get(*agent)
        return self.nodes.robot.rules.believed_group(found.type_name, found.id, found.group) if found else 0

    def _id_changed(self, _old: int, new: int) -> None:
        """Whoever registered here asked for the old id, which is another robot's now; as after a restart, gateways
        register again what is wanted of the new one. The emergency stop holds."""
        self.nodes.forget_all()
        self.offers.close()
        self.nodes.robot.agent_id = new
        self.offers = Offers(self.nodes.robot, self.streams.publish, self._graph_changed)

    def _link(self, up: bool) -> None:
        """Without a router nobody is seen to leave, and no command comes: after a lease all commanders count as gone.

        A change to another router is shorter.
        """
        if not up and not self.agent.mesh.linked:
            lease_s = self.agent.mesh.settings.lease_ms / 1000
            asyncio.get_running_loop().call_later(lease_s, self._still_cut_off)

    def _still_cut_off(self) -> None:
        if not self.agent.mesh.linked:
            self.nodes.cut_off()

    def _presence(self, agent: AgentInfo, online: bool) -> None:
        agent_key = Registrant(agent.type, agent.id)
        if not online:
            self.nodes.rights.changed()
            self._forget(agent_key, for_good=agent_key not in self._sessions)
            return
        before = self._sessions.pop(agent_key, None)
        if len(self._sessions) >= SESSIONS:  # whoever has the id next could not be told from who had it
            gone = next(iter(self._sessions))
            del self._sessions[gone]
            if gone not in self.agent.directory:
                self._forget(gone, for_good=True)
        self._sessions[agent_key] = agent.session
        if before == agent.session:
            self.nodes.returned(agent_key)
        elif before is not None:  # whether it was seen to leave or not: what it had is not the next one's
            self._forget(agent_key, for_good=True)
        self.nodes.arrived(agent_key)

    def _forget(self, gone: Registrant, *, for_good: bool = False) -> None:
        self.nodes.forget(gone, for_good=for_good)
        self.offers.forget(gone)
        self._clocks.left(gone)
        for answer, asker in list(self._answering.items()):
            if asker == gone:
                answer.cancel()


def _ignore(_: Message) -> None:
    """What comes while the robot ends."""


def _own(request: _Registration, call: Call) -> _Registration:
    """A registration by the agent that it is for."""
    check_own(request, (type_number(call.sender_type), call.sender_id))
    return request
