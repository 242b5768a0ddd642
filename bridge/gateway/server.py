"""The gateway: all sockets of one process, and their place on the mesh.

A frame from a headset: socket → `Connection` → `TcpAgent` (whole? allowed? from whom?) → `Forwarding` → mesh.
A frame to a headset: mesh → `Delivery` (for whom?) → `Connection` → socket. It never turns back: two headsets on one
gateway talk through the mesh as well, inside this process's own Zenoh session.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from functools import partial

from bridge import link_bytes
from bridge.listening import for_others
from bridge.settings import GatewaySettings
from bridge.tokens.store import path_of
from macs_zenoh.errors import UsageError
from macs_zenoh.losses import Losses
from macs_zenoh.managers import Managers
from macs_zenoh.mesh import Mesh
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.credit import Credits
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.directory import Change
from macs_zenoh.protocol.keyexpr import BROADCAST, STREAM, UNICAST
from macs_zenoh.protocol.limits import REGISTRATION_REQUESTS
from macs_zenoh.protocol.messages import ROS, UNITY, AccessRefused
from macs_zenoh.protocol.rate_limit import Pace, together
from macs_zenoh.protocol.recipient import Recipient, to_agent
from macs_zenoh.protocol.registrations import AgentKey
from macs_zenoh.protocol.rights import Grant
from macs_zenoh.protocol.tcp_agent import (
    Answered,
    Asked,
    AskedOnline,
    Event,
    Forbidden,
    Joined,
    Limits,
    NotLetIn,
    NotResumed,
    Registering,
    RegistrationRefused,
    Resumed,
    Sent,
    Streamed,
    TcpAgent,
    Withdrawn,
)
from macs_zenoh.protocol.trace import SOCKET
from macs_zenoh.protocol.wire import Layout
from macs_zenoh.registration_calls import StreamChanges
from macs_zenoh.timeouts import within

from .agents import Agents
from .connection import Connection
from .declarations import AgentDeclarations
from .delivery import Delivery
from .departures import Departures, Pieces
from .door import Door, Entrance, entrances
from .entry import Entry
from .forwarding import Forwarding
from .groups import Groups
from .join_log import JoinLog
from .judged import JudgedFrames
from .leases import Leases
from .listeners import Listeners
from .managing import Managing
from .memory import Memory
from .node_registry import NodeRegistry
from .on_the_way import Stream
from .record import Record
from .refusing import Refusing
from .renumbering import Renumbering
from .robot_ids import RobotIds
from .roll import Roll
from .shares import Rounds
from .sleepers import Sleepers
from .stead import Stead
from .subscriptions import Subscriptions
from .told import Told
from .waiting import NAMED_S

log = logging.getLogger("macs.gateway")

FLUSH_S = 1.0

NO_MANAGERS: Managers = {}


class Gateway:
    """A TCP server whose connections are agents on the mesh. ``drops`` counts what was lost, by name."""

    def __init__(self, mesh: Mesh, settings: GatewaySettings, managers: Managers = NO_MANAGERS) -> None:
        self.mesh = mesh
        self._managing = Managing(managers)
        self._join_log = JoinLog()
        self._all_closed = asyncio.Event()
        self.settings = settings
        self.port = 0
        self.agents = Agents()
        self._presence = Presence(mesh, self._tell, lambda contested: self._renumbering.contested(contested))
        self._drops = Losses(log)
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._limits = Limits(
            max_frame_bytes=settings.max_frame_bytes,
            handshake_timeout_s=settings.handshake_timeout_s,
            idle_timeout_s=settings.idle_timeout_s,
            frames_per_s=settings.max_frames_per_s,
        )
        self._scratch = bytearray(FrameDecoder.SPACE_BYTES)  # sockets of one loop receive one after the other
        self._credits: Credits[str] = Credits(settings.max_frames_per_s)
        self._memory = Memory(settings.outbox_bytes, settings.max_frame_bytes)
        self._numbers = 0
        self._received_bytes = self._sent_bytes = 0
        """Of connections that have ended."""
        self._requests = together(settings.max_requests_per_s, time.monotonic())
        """Of all who send robots much."""
        self._leaving = Pieces(self._has_closed, self.agents.end_presences)
        self._departures = departures = Departures(self.agents.online, lambda gone: self._roll.telling(gone))
        self._subscriptions = Subscriptions(mesh)
        self._record = record = Record(self._drops)
        self._door = Door(
            path_of(settings.tokens_file),
            on_changed=self._rights_changed,
            on_ended=lambda connection: self._refusing.ended(connection),
            on_look=lambda: self.listeners.look(),
            on_file=record.token,
            on_refused=lambda host, count: self._refusing.request(host, count),
        )
        self.listeners = Listeners(settings, entrances(settings), self._door, self._connection, self._drops, self)
        self.directory = self._presence.directory
        """Who is online."""
        self._robot_ids = RobotIds(settings.robots)
        self._refusing = Refusing(self._door, record, self._drops)
        stead, judged = Stead(mesh, self._layout), JudgedFrames()
        self._forwarding = Forwarding(mesh, self.agents, self.directory, judged, self._refusing.no_router)
        known, rounds = (self.agents, self.directory, self._layout), self.rounds
        self._delivery = Delivery(*known, stead, mesh.drops, judged, self._forwarding.afar, rounds)
        self._declarations = AgentDeclarations(mesh, self.agents, self.directory, self._delivery, self._layout, stead)
        self._roll = Roll(self._presence, self.agents)
        self._groups = Groups(self.agents, self._presence, self._subscriptions, self._delivery, self._roll, departures)
        self._sleepers = Sleepers(
            settings.resume_s, self.agents, self._presence, on_asleep=self._falls_asleep, note=record.agent
        )
        self._leases = Leases(
            mesh,
            settings.block,
            settings.blocks,
            on_block=self._block_leased,
            on_ids=lambda: self._entry.greet_waiting(),
            on_lost=lambda block: self._renumbering.block_lost(block),
        )
        self._entry = Entry(
            settings, self._leases, self._drops, record, is_taken=self._is_not_for_headsets, on_id=self._greet
        )
        self._registry = NodeRegistry(
            mesh,
            self.directory,
            self._layout,
            self.agents,
            record,
            on_streams=self._streams_wanted,
            tell=settings.tell_refusals,
        )
        self._renumbering = Renumbering(
            mesh.zid,
            self._presence,
            self.agents,
            self._leases,
            self._registry.robots,
            self._declarations,
            on_change=self._id_changes,
            on_block_left=lambda block: self._subscriptions.remove(UNICAST.every(type=UNITY, block=block)),
        )

    @property
    def rounds(self) -> Rounds:
        """Who waits for his turn to be read from."""
        return self._memory.rounds

    @property
    def blocks(self) -> list[int]:
        """The blocks of ids that this gateway gives out."""
        return self._leases.blocks

    @property
    def drops(self) -> Counter[str]:
        """What was lost, by name: here, and for connections that have ended; ``wrong_sender`` was only put right."""
        return self._drops + self._delivery.drops

    def amounts(self) -> list[tuple[str, str, int]]:
        """What all connections together have of what is limited: name, what it is, how much."""
        return [
            ("macs_outbox_bytes", "bytes that wait for agents that read slowly", self._memory.waiting.used),
            ("macs_unfinished_bytes", "bytes of frames that have begun", self._memory.unfinished.used),
            ("macs_registered_nodes", "interface nodes that agents have registered", self._registry.nodes.used),
            ("macs_streams", "topics of robots that somebody here receives", len(self._delivery.streams)),
            ("macs_waiting_connections", "connections that wait for an id", len(self._entry)),
        ]

    def carried(self) -> tuple[int, int]:
        """Bytes that were received from and sent to agents, with those that have left."""
        connections = self.agents.connections()
        received = sum(each.received_bytes for each in connections)
        return self._received_bytes + received, self._sent_bytes + sum(each.sent_bytes for each in connections)

    # -- life ----------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Lease a block of ids, join the mesh and listen.

        Raises ConfigError when the block is somebody else's, Unreachable when the port cannot be had.
        """
        self._record.open(self.settings, f"gateway {joined(for_others(self.settings.host), self.settings.port)}")
        self.mesh.tells, self.mesh.away = self._now, self._away
        self.mesh.told = Told(self.agents, lambda: self.drops).now
        link_bytes.tell_of(self.mesh)
        await self._presence.start()
        self.mesh.on_link(lambda up: self._registry.robots.repeat_all() if up else None)
        await self._leases.take()
        self._subscriptions.add(BROADCAST.every(), self._delivery.broadcast)
        self._subscriptions.keep(self.mesh.answer_pings())
        self._subscriptions.keep(self._forwarding.afar.listen())
        await self.listeners.open()
        self.port = self.listeners.port
        self._door.start()
        self.mesh.address = joined(for_others(self.settings.host), self.port)
        log.info("listening on %s%s", self.address, self.listeners.others)

    @property
    def address(self) -> str:
        """Where it listens, as headsets are told it."""
        return joined(self.settings.host, self.port)

    def _away(self) -> list[AgentKey]:
        """Agents of which nothing was heard for a while."""
        now = time.monotonic()
        return sorted(connection.key for connection in self.agents.online() if connection.is_away(now))

    def _now(self) -> dict[str, int]:
        """What `macs doctor` is told besides losses."""
        waiting = {"waiting_for_id": self._entry.waiting} if self._entry.longest_s > NAMED_S else {}
        return {**waiting, **self._record.troubles()}

    def keep_record(self, event: str, by: Mapping[str, str], what: str = "", result: str = "done") -> None:
        """Note in the record of who did what, if one is kept, what was done at the web port."""
        self._record.other(event, by, what, result)

    async def close(self) -> None:
        """Stop accepting, tell the mesh, send what waits for ``FLUSH_S`` at most, leave."""
        self.listeners.close()
        self._sleepers.close()
        self._door.close()
        self._renumbering.close()
        self._registry.robots.close()
        connections = [*self.agents.connections(), *self._entry]
        self._entry.close()
        self._leaving.hurry()
        if connections:
            for connection in connections:
                if connection.greeted and connection.peer.extensions:
                    self._refusing.tell(connection, AccessRefused("stops", "the gateway stops"))
                connection.finish("the gateway stops")
            with suppress(asyncio.TimeoutError):
                await within(self._all_closed.wait(), FLUSH_S)
            for connection in connections:
                connection.abort()
        await self.listeners.end()
        self._leaving.finish()
        self._departures.close()
        self._forwarding.close()
        self._leases.close()
        self._declarations.close()
        self._join_log.close()
        self._presence.close()
        self._subscriptions.close()
        await asyncio.to_thread(self._record.close)
        if self.drops:
            log.info("lost in all: %s", ", ".join(f"{name} {count}" for name, count in sorted(self.drops.items())))

    # -- connections ---------------------------------------------------------------------------------------------

    def _connection(self, entrance: Entrance) -> Connection:
        bytes_, timeout_s = self.settings.outbox_bytes, self.settings.write_timeout_s
        return Connection(self, entrance, memory=self._memory, outbox_bytes=bytes_, write_timeout_s=timeout_s)

    def opened(self, connection: Connection) -> bool:
        """Let a connection in, or not. It is greeted at once, or as soon as there is an id for it."""
        return self._entry.let_in(connection)

    def _greet(self, connection: Connection, agent_id: int) -> None:
        """There is an id for a connection."""
        self._numbers += 1
        now = time.monotonic()
        peer = TcpAgent(
            agent_id,
            self._numbers,
            now,
            limits=self._limits,
            credit=self._credits.enter(connection.host, now),
            custom=self._managing.custom,
            layout=self._layout,
            scratch=self._scratch,
            closed_groups=self._entry.admission.closed_groups(connection.host),
            admit=self._door.admit(connection),
            stranger=connection.stranger,
            recipient=Recipient(partial(self._registry.knows, connection), self.settings.robot_packages),
            resume=self._sleepers.resume_for(connection) if self.settings.resume_s else None,
            members=self._robots_in,
        )
        self.agents.enter(agent_id, connection)
        self._forwarding.enter(connection)
        connection.greet(peer)

    def _robots_in(self, group: int) -> list[int]:
        return [agent.id for agent in self.directory.of_type(ROS) if agent.group == group]

    def _is_elsewhere(self, agent_id: int) -> bool:
        return self.directory.is_elsewhere(agent_id, self.mesh.zid)

    def _is_not_for_headsets(self, agent_id: int) -> bool:
        return agent_id in self._robot_ids or self._is_elsewhere(agent_id)

    def _block_leased(self, block: int) -> None:
        self._subscriptions.add(UNICAST.every(type=UNITY, block=block), self._delivery.inbox)

    def _id_changes(self, connection: Connection) -> None:
        """A connection is about to have another id."""
        self._roll.changed()
        self._forwarding.forget(connection)
        self._delivery.forget()

    def closed(self, connection: Connection) -> None:
        """Forget a connection; its presence ends at once, or as soon as those have ended that left just before."""
        self._leaving.put(connection, seen=self._groups.is_seen(connection), first=connection.is_needed)

    def _has_closed(self, connection: Connection) -> None:
        self._door.leave(connection)
        self._entry.forget(connection)
        self._sleepers.left(connection)
        if not connection.asleep:
            self._entry.leave_address(connection)
        if not connection.greeted:
            self._entry.leave(connection)
            return
        if connection.peer.dials_a_router:
            what = "%s is a Zenoh program: it wants a router, and this is a gateway"
            self._drops.once("zenoh_program", what, connection.address)
        self._forwarding.leave(connection)
        self._roll.changed()
        if drops := connection.all_drops():
            self._drops += drops
        self._received_bytes += connection.received_bytes
        self._sent_bytes += connection.sent_bytes
        self._delivery.forget()
        was_online = self._groups.leave(connection)
        self._leases.give_back(connection.agent_id)
        self._credits.leave(connection.host, connection.peer.credit, time.monotonic())
        self._registry.leave(connection, was_online=was_online)
        if was_online:
            self._declarations.undeclare(connection.key)
            self._record.agent("left", connection)
            log.debug("%s is offline", connection)
        if not self.agents:
            self._all_closed.set()
        self._entry.greet_waiting()

    def sleeps(self, connection: Connection) -> bool:
        """Whether an agent whose socket is gone may come back, and sleeps now."""
        return self._sleepers.sleeps(connection)

    def _falls_asleep(self, connection: Connection) -> None:
        self._entry.leave_address(connection)
        self._forwarding.sleeps(connection)

    def _resume(self, newcomer: Connection, event: Resumed) -> None:
        """A newcomer is who was here before: what was his own is not needed."""
        former = self.agents.find(event.former.agent_type, event.former.agent_id)
        assert former is not None
        self._entry.known(newcomer)
        self._entry.forget(newcomer)
        self._forwarding.never_mind(newcomer)
        self.agents.never_mind(event.spare_id)
        self._leases.give_back(event.spare_id)
        self._credits.leave(newcomer.host, event.spare_credit, time.monotonic())
        self._door.is_now(newcomer, former)
        with self._registry.moved(former), self._entry.moved(former):
            self._sleepers.resumed(newcomer, event)
        self._entry.greet_waiting()

    # -- from a TCP agent to the mesh ----------------------------------------------------------------------------

    def forward(self, connection: Connection, sent: Sent) -> None:
        """The agent sent a frame to others."""
        if self.mesh.tracing.marks:
            self.mesh.tracing.note((SOCKET, time.time_ns()))
        if connection.unseen:
            self._groups.show(connection)
        self._forwarding.forward(connection, sent)

    def received(self, connection: Connection) -> None:
        """All events of one read were passed on."""
        self._forwarding.finish(connection)

    def pace(self) -> Pace:
        """For a new connection."""
        settings = self.settings
        return Pace(settings.max_commands_per_s, settings.max_requests_per_s, time.monotonic(), self._requests)

    def handle(self, connection: Connection, event: Event) -> None:
        """One thing a TCP agent did."""
        if connection.unseen and not isinstance(event, Joined):
            self._groups.show(connection)
        if isinstance(event, Streamed):
            self._forwarding.stream(connection, event)
            return
        self._forwarding.flush()
        if isinstance(event, Answered):
            self._forwarding.answered(connection, event.number)
        elif isinstance(event, Joined):
            self._joined(connection, event)
            connection.charge()
        elif isinstance(event, Registering):
            self._registry.register(connection, event)
            connection.charge(REGISTRATION_REQUESTS)
        elif isinstance(event, RegistrationRefused):
            self._registry.refused(connection.key, event.refused)
        elif isinstance(event, Forbidden):
            self._refusing.forbidden(connection, event)
        elif isinstance(event, NotLetIn):
            self._refusing.not_let_in(connection)
        elif isinstance(event, Withdrawn):
            self._registry.withdraw(connection, event)
        elif isinstance(event, Resumed):
            self._resume(connection, event)
        elif isinstance(event, NotResumed):
            self._refusing.not_resumed(connection)
        elif isinstance(event, AskedOnline):
            connection.send_call(to_agent(self._roll.answer(connection), request_id=event.request_id))
            connection.charge()
        elif isinstance(event, Asked):
            self._managing.ask(connection, event)
            connection.charge()

    def _rights_changed(self, connection: Connection, grant: Grant) -> None:
        """A token has other rights: they hold for all that is read from now on."""
        connection.take(self._refusing.changed(connection, grant), time.monotonic())

    def _joined(self, connection: Connection, event: Joined) -> None:
        if self.agents.find(*connection.key) is connection:
            self._groups.change(connection)
            return
        self._entry.known(connection)
        if event.agent_type != UNITY and not self._admit(connection):
            return
        if not self._entry.may_join(connection):
            return
        self._declarations.declare(connection)
        self._groups.enter(connection)
        self._sleepers.joined(connection)
        self._renumbering.joined(connection)
        self._record.agent("joined", connection, f"group {event.group}" if event.group else "")
        self._join_log.joined(connection)

    def _admit(self, connection: Connection) -> bool:
        """Give an agent that is no headset an id that it may have; it is not told, and does not mind. False: there is
        none, and its connection ends."""
        before = connection.agent_id
        agent_id = self._robot_ids.choose(before, lambda each: each in self.agents.ids or self._is_elsewhere(each))
        if agent_id is None:
            self._drops["robot_not_allowed"] += 1
            self._record.address("refused", connection.address, "join as robot", self._robot_ids.problem)
            connection.close(self._robot_ids.problem)
            return False
        if agent_id != before:
            self._id_changes(connection)
            self.agents.renumber(connection, agent_id)
            self.agents.forget_former((connection.peer.agent_type, before), connection)
            self._leases.give_back(before)
            self._entry.forget(connection)
        return True

    # -- subscriptions -------------------------------------------------------------------------------------------

    def _streams_wanted(self, changes: StreamChanges) -> None:
        """Listen to exactly those streams of robots on which somebody is registered."""
        delivery = self._delivery
        for (robot_id, node), registrants in changes:
            try:
                key = STREAM.of(type=ROS, id=robot_id, node=node)
            except UsageError as error:  # it was judged when it came; should another way in be found, others go on
                self._drops["bad_name"] += 1
                log.warning("a registration on robot %d is left out: %s", robot_id, error)
                continue
            if registrants is None:
                delivery.streams.pop(key, None)
                self._subscriptions.leave(key)
            else:
                delivery.streams[key] = Stream.of((ROS, robot_id), node, registrants, delivery.streams.get(key))
                # whether a robot keeps a stream for recovery is seen from its messages: others cost nothing more
                self._subscriptions.add(key, delivery.stream, at_once=delivery.stream_at_once, reliable=True)

    # -- presence ------------------------------------------------------------------------------------------------

    def _tell(self, changes: list[Change]) -> None:
        self._roll.changed()
        gone = [each.agent for each in changes if not (each.online or self.agents.is_here(each.agent, self.mesh.zid))]
        self._departures.tell(gone, [change.agent.key for change in changes if change.online])
        for change in changes:
            try:
                self._registry.robots.presence(change)
            except Exception:  # one robot's registrations must not cost another its own
                log.exception("telling %s what is registered for it failed", change.agent)
