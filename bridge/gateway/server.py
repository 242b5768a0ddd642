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
from collections.abc import Iterator
from contextlib import suppress
from functools import partial

from msgspec import structs

from bridge.audit import NO_AUDIT, Audit, open_audit, who
from bridge.listening import for_others
from bridge.settings import GatewaySettings
from bridge.tokens.store import path_of
from macs_zenoh.errors import Refused, UsageError
from macs_zenoh.losses import Losses
from macs_zenoh.managers import Asker, Managers
from macs_zenoh.mesh import AtOnce, Mesh, OnBatch, Subscription
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.budget import Budget
from macs_zenoh.protocol.credit import Credit, Credits
from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.directory import AgentInfo, Change
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, STREAM, UNICAST, type_name
from macs_zenoh.protocol.limits import (
    NAMED_EACH,
    NAMED_IN_ALL,
    NAMED_PER_ADDRESS,
    NODES_EACH,
    NODES_IN_ALL,
    NODES_PER_ADDRESS,
)
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AccessRefused,
    AddNode,
    DataRefused,
    Metadata,
    NodeRefused,
    NodeType,
    Refusal,
    RemoveNode,
    encode_data,
)
from macs_zenoh.protocol.ping import GatewayAgent, encode_told
from macs_zenoh.protocol.rate_limit import TOGETHER, Pace
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
from macs_zenoh.registration_calls import RobotCalls, StreamChanges
from macs_zenoh.timeouts import within

from .admission import Admission, Churn
from .agents import Agents, Group
from .connection import Connection
from .declarations import AgentDeclarations
from .delivery import Delivery, Stream
from .departures import PIECE_S, Departures, Pieces
from .door import Door, Entrance, entrances
from .forwarding import Forwarding
from .judged import JudgedFrames
from .leases import Leases
from .listeners import Listeners
from .memory import Memory
from .renumbering import Renumbering
from .robot_ids import RobotIds
from .roll import Roll
from .sleepers import Sleepers
from .stead import Stead
from .waiting import NAMED_S, WaitingRoom

log = logging.getLogger("macs.gateway")

FLUSH_S = 1.0

CALM_S = 0.25
"""So long after one change of its group an agent's next one is seen by others."""

OVERLAP_S = 0.1
"""How long an agent is seen in its former group as well: in no moment it seems to be gone."""

NO_MANAGERS: Managers = {}


class Gateway:
    """A TCP server whose connections are agents on the mesh. ``drops`` counts what was lost, by name."""

    def __init__(self, mesh: Mesh, settings: GatewaySettings, managers: Managers = NO_MANAGERS) -> None:
        self.mesh = mesh
        self._managers = managers
        self._custom = {name: manager.Data for name, manager in managers.items()}
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
        self._admission = Admission(
            settings.allow, settings.max_connections, settings.max_connections_per_address, settings.groups
        )
        self._nodes = Budget("interface nodes", each=NODES_EACH, per_address=NODES_PER_ADDRESS, total=NODES_IN_ALL)
        named = "robots and groups named in registrations"
        self._named = Budget(named, each=NAMED_EACH, per_address=NAMED_PER_ADDRESS, total=NAMED_IN_ALL)
        self._credits: Credits[str] = Credits(settings.max_frames_per_s)
        self._memory = Memory(settings.outbox_bytes, settings.max_frame_bytes)
        self._numbers = 0
        self._received_bytes = self._sent_bytes = 0
        """Of connections that have ended."""
        self._requests = Credit(TOGETHER * settings.max_requests_per_s, time.monotonic())
        """Of all who send robots much."""
        self._churn = Churn()
        self._coming: dict[Connection, asyncio.TimerHandle] = {}
        """Who is not greeted yet, since many from there have come and gone."""
        self._greeting: asyncio.Handle | None = None
        self._leaving = Pieces(self._has_closed)
        self._departures = Departures(self.agents.online, lambda gone: self._roll.telling(gone))
        self._waiting = WaitingRoom(settings.handshake_timeout_s, self._no_id)
        self._subscriptions: dict[str, Subscription] = {}
        self._door = Door(
            path_of(settings.tokens_file),
            on_changed=self._rights_changed,
            on_ended=self._token_ended,
            on_look=lambda: self.listeners.look(),
            on_file=lambda event, name: self._audit.record(event, who(token=name)),
        )
        self.listeners = Listeners(settings, entrances(settings), self._door, self._connection, self._drops, self)
        self.directory = self._presence.directory
        """Who is online."""
        self._robot_ids = RobotIds(settings.robots)
        self._audit: Audit = NO_AUDIT
        stead = Stead(mesh, self._layout)
        judged = JudgedFrames()
        self._forwarding = forwarding = Forwarding(mesh, self.agents, self.directory, judged)
        self._delivery = Delivery(self.agents, self.directory, self._layout, stead, judged, forwarding.afar)
        self._declarations = AgentDeclarations(mesh, self.agents, self.directory, self._delivery, self._layout, stead)
        self._roll = Roll(self._presence, self.agents)
        self._sleepers = Sleepers(
            settings.resume_s,
            self.agents,
            self._presence,
            on_asleep=self._falls_asleep,
            note=lambda event, connection: self._audit.record(event, _who(connection)),
        )
        self._leases = Leases(
            mesh,
            settings.block,
            settings.blocks,
            on_block=self._block_leased,
            on_ids=self._greet_waiting,
            on_lost=lambda block: self._renumbering.block_lost(block),
        )
        self._robots = RobotCalls(
            mesh, self.directory, self._layout, on_streams=self._streams_wanted, on_refused=self._tell_refusal
        )
        self._renumbering = Renumbering(
            mesh.zid,
            self._presence,
            self.agents,
            self._leases,
            self._robots,
            self._declarations,
            on_change=self._id_changes,
            on_block_left=lambda block: self._unsubscribe(UNICAST.every(type=UNITY, block=block)),
        )

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
            ("macs_registered_nodes", "interface nodes that agents have registered", self._nodes.used),
            ("macs_streams", "topics of robots that somebody here receives", len(self._delivery.streams)),
            ("macs_waiting_connections", "connections that wait for an id", len(self._waiting) + len(self._coming)),
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
        settings = self.settings
        name = f"gateway {joined(for_others(settings.host), settings.port)}"
        self._audit = open_audit(
            settings.audit_file, name, settings.audit_max_bytes, settings.audit_files, self._audit_lost
        )
        self.mesh.tells, self.mesh.away, self.mesh.told = self._now, self._away, self._told
        await self._presence.start()
        self.mesh.on_link(lambda up: self._robots.repeat_all() if up else None)
        await self._leases.take()
        self._subscribe(BROADCAST.every(), self._delivery.broadcast)
        self._subscriptions["ping"] = self.mesh.answer_pings()
        self._subscriptions["slow"] = self._forwarding.afar.listen()
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

    def _told(self) -> bytes:
        """Its agents and what was lost, for who asks by a ping."""
        lost = self.drops
        for connection in self.agents.connections():
            lost.update(connection.all_drops())
        return encode_told(self._agents(), lost)

    def _agents(self) -> Iterator[GatewayAgent]:
        now = time.monotonic()
        for connection in self.agents.online():
            age_s = round(now - connection.greeted_at, 1)
            yield GatewayAgent(*connection.key, connection.address, connection.peer.grant.name, age_s)

    def _now(self) -> dict[str, int]:
        """What `macs doctor` is told besides losses."""
        waiting = {"waiting_for_id": len(self._waiting)} if self._waiting.longest_s > NAMED_S else {}
        return {**waiting, **self._audit.troubles()}

    def _audit_lost(self, count: int) -> None:
        self._drops.once("audit_lost", "the record of who did what is not whole", count=count, level=logging.ERROR)

    async def close(self) -> None:
        """Stop accepting, tell the mesh, send what waits for ``FLUSH_S`` at most, leave."""
        self.listeners.close()
        self._sleepers.close()
        self._door.close()
        self._renumbering.close()
        self._robots.close()
        connections = [*self.agents.connections(), *self._waiting, *self._coming]
        self._waiting.close()
        if connections:
            for connection in connections:
                if connection.greeted and connection.peer.extensions:
                    self._tell_access(connection, AccessRefused("stops", "the gateway stops"))
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
        self._presence.close()
        for subscription in self._subscriptions.values():
            subscription.close()
        await asyncio.to_thread(self._audit.close)
        if self.drops:
            log.info("lost in all: %s", ", ".join(f"{name} {count}" for name, count in sorted(self.drops.items())))

    # -- connections ---------------------------------------------------------------------------------------------

    def _connection(self, entrance: Entrance) -> Connection:
        settings = self.settings
        return Connection(
            self,
            entrance,
            memory=self._memory,
            outbox_bytes=settings.outbox_bytes,
            write_timeout_s=settings.write_timeout_s,
        )

    def opened(self, connection: Connection) -> bool:
        """Let a connection in, or not. It is greeted at once, or as soon as there is an id for it."""
        connection.stranger = connection.entrance.wants_token(connection.host)
        refusal = self._admission.judge(connection.host, stranger=connection.stranger)
        if refusal is not None:
            name, why = refusal
            self._drops.once(name, "%s is refused: %s", connection.address, why)
            self._audit.record("refused", who(address=connection.address), name, why)
            return False
        self._admission.enter(connection.host, stranger=connection.stranger)
        wait_s = self._churn.wait_s(connection.host, time.monotonic())
        if wait_s:
            self._drops.once("coming_and_going", "%s waits: many from there have just left", connection.address)
            timer = asyncio.get_running_loop().call_later(wait_s, self._let_in, connection)
            self._coming[connection] = timer
        else:
            self._let_in(connection)
        return True

    def _let_in(self, connection: Connection) -> None:
        self._coming.pop(connection, None)
        self._waiting.enter(connection)
        self._greet_waiting()

    def _greet_waiting(self) -> None:
        """Give waiting connections ids of our blocks that no agent of any type has, in pieces."""
        if self._greeting is None:
            self._greet_some()

    def _greet_some(self) -> None:
        self._greeting = None
        until = time.monotonic() + PIECE_S
        while self._waiting:
            if time.monotonic() > until:
                self._greeting = asyncio.get_running_loop().call_soon(self._greet_some)
                return
            agent_id = self._leases.take_id(self._is_not_for_headsets, wanting=len(self._waiting))
            if agent_id is None:
                if self._leases.exhausted:
                    for connection in self._waiting:
                        self._no_id(connection)
                return
            connection = self._waiting.next()
            self._numbers += 1
            now = time.monotonic()
            peer = TcpAgent(
                agent_id,
                self._numbers,
                now,
                limits=self._limits,
                credit=self._credits.enter(connection.host, now),
                custom=self._custom,
                layout=self._layout,
                scratch=self._scratch,
                closed_groups=self._admission.closed_groups(connection.host),
                admit=self._door.admit(connection),
                stranger=connection.stranger,
                recipient=Recipient(partial(self._registered_there, connection), self.settings.robot_packages),
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

    def _no_id(self, connection: Connection) -> None:
        """There was no id for a connection in time. It cannot be told: agents give up when anything comes before their
        id, and they are waiting for that."""
        self._waiting.leave(connection)
        self._drops.once("no_id", "%s leaves: there is no id for it", connection.address)
        connection.abort()

    def _block_leased(self, block: int) -> None:
        self._subscribe(UNICAST.every(type=UNITY, block=block), self._delivery.inbox)

    def _id_changes(self, connection: Connection) -> None:
        """A connection is about to have another id."""
        self._roll.changed()
        self._forwarding.forget(connection)
        self._delivery.forget()

    def closed(self, connection: Connection) -> None:
        """Forget a connection; its presence ends at once, or as soon as those have ended that left just before."""
        self._leaving.put(connection)

    def _has_closed(self, connection: Connection) -> None:
        self._door.leave(connection)
        self._sleepers.left(connection)
        if not connection.asleep:
            self._leaves_address(connection)
        if not connection.greeted:
            if (timer := self._coming.pop(connection, None)) is not None:
                timer.cancel()
            self._waiting.leave(connection)
            return
        if connection.peer.dials_a_router:
            what = "%s is a Zenoh program: it wants a router, and this is a gateway"
            self._drops.once("zenoh_program", what, connection.address)
        self._forwarding.leave(connection)
        self._roll.changed()
        self._drops += connection.all_drops()
        self._received_bytes += connection.received_bytes
        self._sent_bytes += connection.sent_bytes
        self._delivery.forget()
        was_online, empty_group = self.agents.leave(connection)
        self._leases.give_back(connection.agent_id)
        self._nodes.set(connection, connection.host, 0)
        self._named.set(connection, connection.host, 0)
        self._credits.leave(connection.host, connection.peer.credit, time.monotonic())
        self._group_emptied(empty_group)
        if was_online:
            self._declarations.undeclare(connection.key)
            self._robots.leave(connection.key)
            self._audit.record("left", _who(connection))
            log.debug("%s is offline", connection)
        if not self.agents:
            self._all_closed.set()
        self._greet_waiting()

    def _leaves_address(self, connection: Connection) -> None:
        """A socket has ended."""
        self._admission.leave(connection.host)
        self._known(connection)
        if connection.greeted:
            now = time.monotonic()
            self._churn.ended(connection.host, now - connection.greeted_at, now)

    def sleeps(self, connection: Connection) -> bool:
        """Whether an agent whose socket is gone may come back, and sleeps now."""
        return self._sleepers.sleeps(connection)

    def _falls_asleep(self, connection: Connection) -> None:
        self._leaves_address(connection)
        self._forwarding.sleeps(connection)

    def _resume(self, newcomer: Connection, event: Resumed) -> None:
        """A newcomer is who was here before: what was his own is not needed."""
        former = self.agents.find(event.former.agent_type, event.former.agent_id)
        assert former is not None
        self._known(newcomer)
        self._forwarding.never_mind(newcomer)
        self.agents.never_mind(event.spare_id)
        self._leases.give_back(event.spare_id)
        self._credits.leave(newcomer.host, event.spare_credit, time.monotonic())
        self._door.is_now(newcomer, former)
        nodes, named = self._nodes.of(former), self._named.of(former)
        self._nodes.set(former, former.host, 0)
        self._named.set(former, former.host, 0)
        self._sleepers.resumed(newcomer, event)
        self._nodes.set(former, former.host, nodes)
        self._named.set(former, former.host, named)
        self._greet_waiting()

    def _not_resumed(self, connection: Connection) -> None:
        connection.drops["not_resumed"] += 1
        count = self._door.failed(connection.entrance, connection.host, "session of its own", "not_resumed")
        if count:
            self._audit.record("refused", who(address=connection.address), "resume", f"{count} times by now")

    def _known(self, connection: Connection) -> None:
        """A connection is no stranger any more."""
        if connection.stranger:
            connection.stranger = False
            self._admission.known(connection.host)

    def _group_emptied(self, group: Group | None) -> None:
        """Nobody of ours is in this group any more."""
        if group is not None:
            self._unsubscribe(GROUP.every(type=group[0], group=group[1]))

    def _registered_there(self, connection: Connection, metadata: Metadata) -> bool:
        """Whether an agent registered a message's node on the robot that sends it."""
        sender = metadata.sender_agent_type, metadata.sender_agent_id
        return sender[0] == ROS and self._robots.registered(connection.key, metadata, int(sender[1] or 0))

    # -- from a TCP agent to the mesh ----------------------------------------------------------------------------

    def forward(self, connection: Connection, sent: Sent) -> None:
        """The agent sent a frame to others."""
        if self.mesh.tracing.marks:
            self.mesh.tracing.note((SOCKET, time.time_ns()))
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
            self._register(connection, event)
            connection.charge()
        elif isinstance(event, RegistrationRefused):
            self._tell_refusal(connection.key, event.refused)
        elif isinstance(event, Forbidden):
            self._tell_forbidden(connection, event)
        elif isinstance(event, NotLetIn):
            count = self._door.failed(connection.entrance, connection.host)
            if count:  # or who knocks all day would push what was done out of the record
                told = "no valid token" if count == 1 else f"no valid token, {count} times by now"
                self._audit.record("refused", who(address=connection.address), "join", told)
            self._tell_access(connection, AccessRefused("no_token", "a valid token is wanted here"))
        elif isinstance(event, Withdrawn):
            self._withdraw(connection, event)
        elif isinstance(event, Resumed):
            self._resume(connection, event)
        elif isinstance(event, NotResumed):
            self._not_resumed(connection)
        elif isinstance(event, AskedOnline):
            self._answer_online(connection, event.request_id)
            connection.charge()
        elif isinstance(event, Asked):
            self._manage(connection, event)
            connection.charge()

    def _register(self, connection: Connection, event: Registering) -> None:
        """An agent registers on a node of robots, or takes that back."""
        kind, agent_id = connection.key  # it may have become another one than when it said this
        node = structs.replace(event.node, registrant_agent_type=kind, registrant_agent_id=agent_id)
        if isinstance(node, AddNode):
            why = None
            if not connection.recipient.is_registered(node):
                why = self._nodes.judge(connection, connection.host)
            naming = self._robots.naming(node, event.robot_ids, event.groups)
            why = why or self._named.judge(connection, connection.host, naming)
            if why is not None:
                connection.complain("too_many_nodes", why)
                self._robots.refuse(node, next(iter(event.robot_ids), 0), why)
                return
            if connection.recipient.existing and (other := connection.recipient.other_type(node)) is not None:
                self._robots.take_back_all(connection.key, other, node.node_name)
                connection.recipient.unregistered(node.node_name, other)
            connection.recipient.registered(node)
            if node.node_type == NodeType.SUBSCRIBER:
                connection.open_direct()
            if not connection.peer.extensions:  # an existing program, which cannot say it itself
                node = structs.replace(node, unity_cdr=True)
        self._robots.register(node, event.robot_ids, event.groups)
        self._audit.record(*_registering(connection, node, event))
        if not isinstance(node, AddNode) and self._robots.find(connection.key, node.node_type, node.node_name) is None:
            connection.recipient.unregistered(node.node_name, node.node_type)
        self._nodes.set(connection, connection.host, connection.recipient.node_count)
        self._named.set(connection, connection.host, self._robots.named(connection.key))

    def _manage(self, connection: Connection, event: Asked) -> None:
        """A management message for a manager that somebody added."""
        asker = Asker(*connection.key, connection.peer.group)
        try:
            answer = self._managers[event.manager].manage(event.data, asker)
            data = encode_data(answer) if answer is not None else None
        except Refused as refusal:
            connection.complain("refused_by_manager", f"{event.manager}: {refusal.reason}")
            if connection.peer.extensions:  # an existing program expects its manager's own answer, or none
                connection.send_call(to_agent(Refusal(refusal.reason), request_id=event.request_id))
            return
        except Exception:
            log.exception("%s failed on a message of %s", event.manager, connection)
            connection.complain("manager_failed", f"{event.manager} failed, see above")
            return
        if data is not None:
            connection.send_call(to_agent(data, request_id=event.request_id))

    def _tell_refusal(self, agent: AgentKey, refused: NodeRefused) -> None:
        connection = self.agents.find(*agent)
        if connection is None:
            return
        what = f"type {refused.node_type} {refused.tos_name or refused.node_name} at robot {refused.robot_id}"
        self._audit.record("register", _who(connection), what, refused.reason)
        connection.peer.registration_refused(refused)
        if self.settings.tell_refusals:
            connection.send_call(to_agent(refused))

    # -- what a token does not permit ------------------------------------------------------------------------------

    def _tell_access(self, connection: Connection, refused: AccessRefused) -> None:
        connection.send_call(to_agent(refused))

    def _tell_forbidden(self, connection: Connection, event: Forbidden) -> None:
        """A message was not let pass: say so, in the way that robots say it to who knows that."""
        about, kind = event.metadata, "not_permitted"
        if not connection.may_tell(
            (about.node_type, about.node_name, about.message_manager, event.robots, event.reason)
        ):
            return
        what = f"type {about.node_type} {about.node_name}" if about.node_name else about.message_manager or "message"
        self._audit.record("message", _who(connection), what, event.reason)
        if not (about.node_name and connection.peer.extensions):
            self._tell_access(connection, AccessRefused(kind, event.reason, about.request_id))
            return
        for robot in event.robots or (0,):
            refused = DataRefused(robot, about.node_type, about.node_name, about.node_name, kind, event.reason)
            connection.send_call(to_agent(refused))

    def _withdraw(self, connection: Connection, event: Withdrawn) -> None:
        """Registrations are not permitted any more."""
        for node, why in event.nodes:
            self._robots.take_back_all(connection.key, node.node_type, node.node_name)
            connection.recipient.unregistered(node.node_name, node.node_type)
            refused = NodeRefused(0, node.node_type, node.node_name, node.tos_name, why)
            self._tell_refusal(connection.key, refused)
        self._nodes.set(connection, connection.host, connection.recipient.node_count)
        self._named.set(connection, connection.host, self._robots.named(connection.key))

    def _rights_changed(self, connection: Connection, grant: Grant) -> None:
        """A token has other rights: they hold at once."""
        log.info("%s has other rights: its token %s has changed", connection, grant.name)
        self._audit.record("rights_changed", _who(connection))
        events = connection.peer.rights_change(grant)
        self._tell_access(connection, AccessRefused("changed", "the rights of this token have changed"))
        for event in events:
            self.handle(connection, event)

    def _token_ended(self, connection: Connection) -> None:
        """A token holds no longer, and so do the connections of who came in by it."""
        self._audit.record("token_ended", _who(connection))
        self._tell_access(connection, AccessRefused("ended", "this token holds no longer"))
        connection.close("its token holds no longer")

    def _joined(self, connection: Connection, event: Joined) -> None:
        if self.agents.find(*connection.key) is connection:
            self._regroup(connection)
            return
        self._known(connection)
        if event.agent_type != UNITY and not self._admit(connection):
            return
        self._declarations.declare(connection)
        self._enter_group(connection)
        self._sleepers.joined(connection)
        self._renumbering.joined(connection)
        by = f" with token {connection.peer.grant.name}" if connection.peer.grant.name else ""
        self._audit.record("joined", _who(connection), f"group {event.group}" if event.group else "")
        log.info("%s is online%s%s", connection, f" in group {event.group}" if event.group else "", by)

    def _admit(self, connection: Connection) -> bool:
        """Give an agent that is no headset an id that it may have; it is not told, and does not mind. False: there is
        none, and its connection ends."""
        before = connection.agent_id
        agent_id = self._robot_ids.choose(before, lambda each: each in self.agents.ids or self._is_elsewhere(each))
        if agent_id is None:
            self._drops["robot_not_allowed"] += 1
            self._audit.record("refused", who(address=connection.address), "join as robot", self._robot_ids.problem)
            connection.close(self._robot_ids.problem)
            return False
        if agent_id != before:
            self._id_changes(connection)
            self.agents.renumber(connection, agent_id)
            self.agents.forget_former((connection.peer.agent_type, before), connection)
            self._leases.give_back(before)
        return True

    def _enter_group(self, connection: Connection) -> None:
        """Let others see an agent in the group that it has told."""
        kind, agent_id = connection.key
        group = connection.peer.group
        if group:
            self._subscribe(GROUP.every(type=kind, group=group), self._delivery.group)
        # the token last: whoever sees the agent can reach it
        number, asleep = connection.peer.connection_number, connection.seen_asleep
        token = self._presence.declare(kind, agent_id, group, number, asleep=asleep)
        before, emptied = self.agents.join(connection, token)
        self._group_emptied(emptied)
        loop = asyncio.get_running_loop()
        connection.grouped_at = loop.time()
        if before is not None:
            loop.call_later(OVERLAP_S, before.close)
        self._delivery.forget()
        self._roll.changed()

    def _regroup(self, connection: Connection) -> None:
        """An agent is in another group. Of many changes others see the first at once, and then the last."""
        loop = asyncio.get_running_loop()
        due = connection.grouped_at + CALM_S
        if loop.time() < due:
            if connection.regrouping is None:
                connection.regrouping = loop.call_at(due, self._regroup, connection)
            return
        connection.regrouping = None
        if self.agents.group_of(connection) != connection.peer.group:
            self._enter_group(connection)
            log.debug("%s is in group %d", connection, connection.peer.group)

    def _answer_online(self, connection: Connection, request_id: int) -> None:
        connection.send_call(to_agent(self._roll.answer(connection), request_id=request_id))

    # -- subscriptions -------------------------------------------------------------------------------------------

    def _streams_wanted(self, changes: StreamChanges) -> None:
        """Listen to exactly those streams of robots on which somebody is registered."""
        for (robot_id, node), registrants in changes:
            try:
                key = STREAM.of(type=ROS, id=robot_id, node=node)
            except UsageError as error:  # it was judged when it came; should another way in be found, others go on
                self._drops["bad_name"] += 1
                log.warning("a registration on robot %d is left out: %s", robot_id, error)
                continue
            if registrants is None:
                self._delivery.streams.pop(key, None)
                self._unsubscribe(key)
            else:
                self._delivery.streams[key] = Stream((ROS, robot_id), node, registrants)
                # whether a robot keeps a stream for recovery is seen from its messages: others cost nothing more
                self._subscribe(key, self._delivery.stream, at_once=self._delivery.stream_at_once, reliable=True)

    def _subscribe(
        self, key: str, on_batch: OnBatch, *, at_once: AtOnce | None = None, reliable: bool = False
    ) -> None:
        if key not in self._subscriptions:
            self._subscriptions[key] = self.mesh.subscribe(key, on_batch, at_once=at_once, reliable=reliable)

    def _unsubscribe(self, key: str) -> None:
        subscription = self._subscriptions.pop(key, None)
        if subscription is not None:
            subscription.close()

    # -- presence ------------------------------------------------------------------------------------------------

    def _is_here(self, agent: AgentInfo) -> bool:
        """Whether it is one of ours: when its presence changes twice in a moment, it can seem to be gone."""
        connection = self.agents.find(agent.type, agent.id) if agent.zid == self.mesh.zid else None
        return connection is not None and connection.peer.connection_number == agent.epoch

    def _tell(self, changes: list[Change]) -> None:
        self._roll.changed()
        gone = [change.agent for change in changes if not (change.online or self._is_here(change.agent))]
        self._departures.tell(gone, [change.agent.key for change in changes if change.online])
        for change in changes:
            try:
                self._robots.presence(change)
            except Exception:  # one robot's registrations must not cost another its own
                log.exception("telling %s what is registered for it failed", change.agent)


def _who(connection: Connection) -> dict[str, str]:
    kind, agent_id = connection.key
    return who(f"{type_name(kind)}/{agent_id}", connection.address, connection.peer.grant.name)


def _registering(
    connection: Connection, node: AddNode | RemoveNode, event: Registering
) -> tuple[str, dict[str, str], str]:
    at = [f"robot {each}" for each in event.robot_ids] + [f"group {each}" for each in event.groups]
    name = node.tos_name if isinstance(node, AddNode) else node.node_name
    verb = "register" if isinstance(node, AddNode) else "deregister"
    return verb, _who(connection), f"type {node.node_type} {name} at {', '.join(at) or 'nobody'}"
