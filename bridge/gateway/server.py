"""The gateway: all sockets of one process, and their place on the mesh.

A frame from a headset: socket → `Connection` → `Peer` (whole? allowed? from whom?) → `handle` → routing → mesh.
A frame to a headset: mesh → `_inbox`, `_group`, `_broadcast` or `_stream` → `Connection` → socket. It never turns
back: two headsets on one gateway talk through the mesh as well, inside this process's own Zenoh session.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from macs_zenoh import blocks
from macs_zenoh.config import GatewaySettings
from macs_zenoh.directory import Change, Directory
from macs_zenoh.errors import ConfigError, Refused, Unreachable, WireError
from macs_zenoh.keyexpr import BROADCAST, CALL, GROUP, LEASE, PRESENCE, STREAM, UNICAST, block_of, type_name
from macs_zenoh.mesh import Mesh, Sample, Subscription, Token, Traffic
from macs_zenoh.messages import (
    BROADCAST as EVERYBODY,
)
from macs_zenoh.messages import (
    ROS,
    UNITY,
    AddNode,
    AgentsGone,
    GoneAgent,
    Metadata,
    NodeType,
    OnlineReply,
    RemoveNode,
    StreamData,
    decode_management,
    encode_data,
)
from macs_zenoh.peer import AskedOnline, Event, Joined, Limits, Peer, Registering, Sent, Streamed
from macs_zenoh.routing import inbox, keys_of, takes_group_copy
from macs_zenoh.wire import Frame, FrameDecoder, Header, Layout, encode_message, parse_frame

from .brake import Brake
from .connection import Connection
from .robots import RobotCalls

log = logging.getLogger("macs.gateway")

PUBLISHER = int(NodeType.PUBLISHER)

SETTLE_S = 0.3
"""How long a claimed block waits for somebody else's claim on it to show up."""


class Route(NamedTuple):
    """Where frames with one destination go: worked out once per connection and destination."""

    keys: list[str]
    header: Header


class Gateway:
    """A TCP server whose connections are agents on the mesh. ``drops`` counts what was lost, by name."""

    KNOWN = 4096

    def __init__(self, mesh: Mesh, settings: GatewaySettings) -> None:
        self.mesh = mesh
        self.settings = settings
        self.block = -1
        self.port = 0
        self.directory = Directory()
        self.drops: Counter[str] = Counter()
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._limits = Limits(settings.max_frame_bytes, settings.handshake_s, settings.silence_s)
        self._scratch = bytearray(FrameDecoder.SMALL_BYTES)  # sockets of one loop receive one after the other
        self._connections: dict[int, Connection] = {}
        self._numbers = 0
        self._tokens: dict[Connection, Token] = {}
        self._routes: dict[Connection, dict[bytes, Route]] = {}
        self._subscriptions: dict[str, Subscription] = {}  # inboxes, groups and calls of our agents
        self._streams: dict[str, Subscription] = {}
        self._always: list[Subscription] = []
        self._targets: dict[str, Connection | None] = {}
        self._metadata: dict[bytes, Metadata] = {}
        self._stream_targets: dict[bytes, dict[str, list[int]]] = {}
        self._dirty: list[Connection] = []
        self._sweep: asyncio.TimerHandle | None = None
        self._server: asyncio.Server | None = None
        self._brake = Brake()
        mesh.on_room(self._brake.release)
        self._robots = RobotCalls(mesh, self.directory, self._layout, on_streams=self._subscribe_streams)

    # -- life ----------------------------------------------------------------------------------------------------

    async def start(self) -> None:
        """Lease a block of ids, join the mesh and listen.

        Raises ConfigError when the block is somebody else's, Unreachable when the port cannot be had.
        """
        self.mesh.on_link(self._link)
        self._always.append(self.mesh.watch_tokens(PRESENCE.every(), self._token))
        for key in await self.mesh.tokens(PRESENCE.every()):
            self._token(key, True)
        await self._lease_block()
        self._always += [
            self.mesh.subscribe(UNICAST.every(type=UNITY, block=self.block), self._inbox),
            self.mesh.subscribe(BROADCAST.every(), self._broadcast),
        ]
        host, port = self.settings.host, self.settings.port
        try:
            self._server = await asyncio.get_running_loop().create_server(self._connection, host, port, backlog=1024)
        except OSError as error:
            raise Unreachable(f"{host}:{port}", f"cannot listen there: {error.strerror or error}") from error
        self.port = self._server.sockets[0].getsockname()[1]
        first = max(1, self.block * 256)
        log.info("listening on %s:%d, giving out agent ids %d..%d", host, self.port, first, self.block * 256 + 255)

    async def close(self) -> None:
        """Stop accepting, send what is gathered, leave the mesh."""
        if self._server is not None:
            self._server.close()
        for connection in list(self._connections.values()):
            connection.close("the gateway stops")
        self._robots.close()
        for subscription in [
            *self._always,
            *self._subscriptions.values(),
            *self._streams.values(),
            *self._tokens.values(),
        ]:
            subscription.close()
        if self._sweep is not None:
            self._sweep.cancel()
        if self.drops:
            log.info("lost in all: %s", ", ".join(f"{name} {count}" for name, count in sorted(self.drops.items())))

    async def _lease_block(self) -> None:
        """Take the lowest free block, or the configured one."""
        wanted = self.settings.block
        while True:
            taken = {int(lease["block"]) for key in await self._leases() if (lease := LEASE.parse(key))}
            block = wanted if wanted is not None else blocks.free_block(taken)
            if block is None:
                raise Unreachable("a free block of ids", "all 256 are leased")
            if block in taken:
                raise ConfigError(
                    "gateway.block", f"block {block} is another gateway's; leave it out to take a free one"
                )
            token = self.mesh.declare_token(LEASE.of(block=block, zid=self.mesh.zid))
            await asyncio.sleep(SETTLE_S)
            holders = [
                str(lease["zid"])
                for key in await self._leases()
                if (lease := LEASE.parse(key)) and lease["block"] == block
            ]
            if blocks.keeps(self.mesh.zid, holders):
                self.block = block
                self._always.append(token)
                return
            token.close()

    async def _leases(self) -> list[str]:
        return await self.mesh.tokens(LEASE.every())

    # -- connections ---------------------------------------------------------------------------------------------

    def _connection(self) -> Connection:
        return Connection(self, outbox_bytes=self.settings.outbox_bytes, stall_s=self.settings.stall_s)

    def opened(self, connection: Connection) -> Peer | None:
        """Give a new connection an id, the lowest free one of our block."""
        if len(self._connections) >= self.settings.max_connections:
            self._refuse(connection, "too_many_connections", f"{len(self._connections)} are connected")
            return None
        online = {agent.id for agent in self.directory if block_of(agent.id) == self.block}
        agent_id = blocks.free_id_in(self.block, online | self._connections.keys())
        if agent_id is None:
            self._refuse(connection, "block_full", f"all ids of block {self.block} are taken")
            return None
        self._connections[agent_id] = connection
        self._routes[connection] = {}
        self._numbers += 1
        return Peer(
            agent_id,
            self._numbers,
            time.monotonic(),
            limits=self._limits,
            layout=self._layout,
            scratch=self._scratch,
        )

    def _refuse(self, connection: Connection, name: str, why: str) -> None:
        self.drops[name] += 1
        log.warning("connection from %s refused: %s", connection.address, why)

    def closed(self, connection: Connection) -> None:
        """Forget a connection; its presence ends at once."""
        self._connections.pop(connection.agent_id, None)
        self._routes.pop(connection, None)
        self.drops += connection.all_drops()
        token = self._tokens.pop(connection, None)
        if token is not None:
            token.close()
            self._robots.leave(connection.key)
            self._membership_changed()
            log.info("%s is offline", connection)

    def stream_depth(self, connection: Connection, node: str) -> tuple[int, bool]:
        """What the headset asked for when it registered on this topic."""
        registered = self._robots.find(connection.key, NodeType.SUBSCRIBER, node)
        return (registered.buffer_size, registered.drop_new) if registered else (10, False)

    # -- from a TCP agent to the mesh ----------------------------------------------------------------------------

    def handle(self, connection: Connection, event: Event) -> None:
        """One thing a TCP agent did."""
        if isinstance(event, Streamed):
            self._forward_stream(connection, event)
        elif isinstance(event, Joined):
            self._joined(connection, event)
        elif isinstance(event, Registering):
            self._robots.register(event.node, event.robot_ids, event.groups)
        elif isinstance(event, AskedOnline):
            self._answer_online(connection, event.request_id)

    def forward(self, connection: Connection, sent: Sent) -> None:
        """Put a frame on the keys of its destinations."""
        frame = sent.frame
        destination = frame.destination
        routes = self._routes[connection]
        route = routes.get(destination)
        if route is None:
            if len(routes) >= self.KNOWN:
                routes.clear()
            header = frame.header
            route = routes[destination] = Route(keys_of(header, *connection.key), header)
        if not route.keys:
            connection.complain("no_destination", "a message names no agent and no group")
            return
        kind = route.header.agent_type
        for agent_id in route.header.ids:
            if (kind, agent_id) not in self.directory and kind != EVERYBODY:
                connection.complain("unknown_agent", f"a message goes to {type_name(kind)}/{agent_id}, not online")
        traffic = Traffic.COMMAND if sent.metadata.node_type == PUBLISHER else Traffic.CALL
        for key in route.keys:
            self.mesh.put(key, frame.data, traffic)
        if self.mesh.backlogged:
            self._brake.hold(connection)

    def _forward_stream(self, connection: Connection, event: Streamed) -> None:
        key = STREAM.of(type=ROS, id=connection.agent_id, node=event.metadata.node_name or "_")
        self.mesh.put(key, event.frame.data, Traffic.STREAM)

    def _joined(self, connection: Connection, event: Joined) -> None:
        if (before := self._tokens.pop(connection, None)) is not None:
            before.close()
        kind, agent_id = connection.key
        presence = PRESENCE.of(type=kind, id=agent_id, group=event.group, zid=self.mesh.zid)
        self._membership_changed()
        if kind == ROS:
            self._serve_robot(connection)
        elif kind != UNITY:
            self._subscribe(inbox(kind, agent_id), self._inbox)
        # the token last: whoever sees the agent can reach it
        self._tokens[connection] = self.mesh.declare_token(presence)
        log.info("%s is online%s", connection, f" in group {event.group}" if event.group else "")

    def _answer_online(self, connection: Connection, request_id: int) -> None:
        ids = {kind: set(self.directory.ids(kind)) for kind in (ROS, UNITY)}
        for own in self._tokens:  # presence comes back through the mesh a moment later
            ids.setdefault(own.key[0], set()).add(own.agent_id)
        reply = OnlineReply(ros_agent_ids=sorted(ids[ROS]), unity_agent_ids=sorted(ids[UNITY]))
        self._call(connection, encode_message(Metadata(request_id=request_id).encode(), encode_data(reply)))

    # -- from the mesh to TCP agents -----------------------------------------------------------------------------

    def _inbox(self, batch: list[Sample]) -> None:
        for key, payload in batch:
            connection = self._targets.get(key)
            if connection is None:
                connection = self._find_target(key)
                if connection is None:
                    continue
            if (frame := self._frame(key, payload)) is not None:
                connection.send_call(frame.message)
                if connection.congested:
                    self._hold_sender(key, connection)
        self._flush()

    def _hold_sender(self, key: str, receiver: Connection) -> None:
        """Slow down a sender on this gateway. Those elsewhere are slowed by nobody: the outbox's limit decides."""
        fields = UNICAST.parse(key)
        sender = self._connections.get(int(fields["from_id"])) if fields else None
        if fields and sender is not None and sender.key == (fields["from_type"], fields["from_id"]):
            receiver.brake.hold(sender)

    def _find_target(self, key: str) -> Connection | None:
        fields = UNICAST.parse(key)
        if fields is None:
            return None
        connection = self._connections.get(int(fields["id"]))
        if connection is None or connection not in self._tokens or connection.peer.agent_type != fields["type"]:
            if (fields["type"], fields["id"]) not in self.directory:
                self.drops["nobody_with_this_id"] += 1
            return None  # or the agent of this id in our block is somebody else's
        if len(self._targets) >= self.KNOWN:
            self._targets.clear()
        self._targets[key] = connection
        return connection

    def _group(self, batch: list[Sample]) -> None:
        for key, payload in batch:
            fields = GROUP.parse(key)
            frame = self._frame(key, payload)
            if fields is None or frame is None:
                continue
            sender = (int(fields["from_type"]), int(fields["from_id"]))
            header = frame.header
            for connection in self._members(int(fields["type"]), int(fields["group"])):
                if takes_group_copy(header, connection.agent_id, sender, connection.peer.agent_type):
                    connection.send_call(frame.message)
        self._flush()

    def _broadcast(self, batch: list[Sample]) -> None:
        for key, payload in batch:
            fields = BROADCAST.parse(key)
            frame = self._frame(key, payload)
            if fields is None or frame is None:
                continue
            sender = (fields["from_type"], fields["from_id"])
            for connection in self._tokens:
                if connection.key != sender:
                    connection.send_call(frame.message)
        self._flush()

    def _stream(self, batch: list[Sample]) -> None:
        for key, payload in batch:
            frame = self._frame(key, payload)
            if frame is None:
                continue
            node = self._metadata[frame.metadata].node_name
            for agent_type, ids in self._registrants(frame).items():
                for agent_id in ids:
                    connection = self._connections.get(agent_id)
                    if (
                        connection is not None
                        and connection in self._tokens
                        and (str(connection.peer.agent_type) == agent_type)
                    ):
                        connection.send_stream(node, frame.message)
        self._flush()

    def _registrants(self, frame: Frame) -> dict[str, list[int]]:
        """Who gets this topic message. The management data of a stream changes only with its registrants."""
        raw = frame.management
        targets = self._stream_targets.get(raw)
        if targets is None:
            try:
                management = decode_management(raw)
            except WireError as error:
                self._bad_frame("stream", error)
                return {}
            targets = management.dest_agents if isinstance(management, StreamData) else {}
            if len(self._stream_targets) >= self.KNOWN:
                self._stream_targets.clear()
            self._stream_targets[raw] = targets
        return targets

    def _frame(self, key: str, payload: bytes) -> Frame | None:
        """The frame of a sample, or None when an agent must not see it: some existing headsets go deaf for good
        on metadata that is empty or no JSON, or on sizes that do not add up."""
        try:
            frame = parse_frame(payload, self._layout)
            raw = frame.metadata
            if raw not in self._metadata:
                if len(self._metadata) >= self.KNOWN:
                    self._metadata.clear()
                self._metadata[raw] = Metadata.decode(raw)
        except WireError as error:
            self._bad_frame(key, error)
            return None
        return frame

    def _bad_frame(self, key: str, error: WireError) -> None:
        self.drops["bad_frame"] += 1
        if self.drops["bad_frame"] == 1:
            log.warning("a frame on %s cannot be used: %s (logged once, counted as bad_frame)", key, error)

    def dirty(self, connection: Connection) -> None:
        """Remember a connection for the next flush."""
        self._dirty.append(connection)

    def _call(self, connection: Connection, message: bytes) -> None:
        connection.send_call(message)
        self._flush()

    def _flush(self) -> None:
        dirty, self._dirty = self._dirty, []
        for connection in dirty:
            connection.flush()

    # -- TCP robots ----------------------------------------------------------------------------------------------

    def _serve_robot(self, connection: Connection) -> None:
        """An existing robot program behind this gateway: its inbox, and the calls that it answers with nothing."""
        self._subscribe(inbox(ROS, connection.agent_id), self._inbox)

        def deliver(kind: type[AddNode | RemoveNode]) -> Callable[[str, bytes], asyncio.Future[bytes]]:
            async def pass_on(key: str, payload: bytes) -> bytes:
                fields = CALL.parse(key) or {}
                sender = (int(fields.get("from_type", 0)), int(fields.get("from_id", 0)))
                if connection not in self._tokens:
                    raise Refused("the robot is not connected")
                body = parse_frame(payload, self._layout).body
                metadata = Metadata(*sender, message_manager=kind.manager)
                self._call(connection, encode_message(metadata.encode(), body))
                return b""

            return pass_on  # type: ignore[return-value]

        for verb, kind in (("add_node", AddNode), ("remove_node", RemoveNode)):
            key = CALL.every(type=ROS, id=connection.agent_id, verb=verb)
            if key not in self._subscriptions:
                self._subscriptions[key] = self.mesh.serve(key, deliver(kind))

    # -- subscriptions -------------------------------------------------------------------------------------------

    def _members(self, agent_type: int, group: int) -> list[Connection]:
        return [c for c in self._tokens if c.peer.group == group and c.peer.agent_type == agent_type]

    def _membership_changed(self) -> None:
        """Subscribe once per group that one of our agents is in; forget inboxes that are nobody's."""
        self._targets.clear()
        online = [c for c in self._connections.values() if c.peer.agent_type]
        groups = {GROUP.every(group=c.peer.group, type=c.peer.agent_type) for c in online if c.peer.group}
        for key in groups:
            self._subscribe(key, self._group)
        own = {
            str(key)
            for c in online
            for key in (
                inbox(*c.key),
                CALL.every(type=ROS, id=c.agent_id, verb="add_node"),
                CALL.every(type=ROS, id=c.agent_id, verb="remove_node"),
            )
        }
        for key in list(self._subscriptions):
            if key not in groups and key not in own:
                self._subscriptions.pop(key).close()

    def _subscribe_streams(self, streams: set[tuple[int, str]]) -> None:
        """Listen to exactly these streams of robots: (robot id, node name)."""
        wanted = {STREAM.of(type=ROS, id=robot_id, node=node) for robot_id, node in streams}
        for key in wanted - self._streams.keys():
            self._streams[key] = self.mesh.subscribe(key, self._stream)
        for key in self._streams.keys() - wanted:
            self._streams.pop(key).close()

    def _subscribe(self, key: str, on_batch: Callable[[list[Sample]], None]) -> None:
        if key not in self._subscriptions:
            self._subscriptions[key] = self.mesh.subscribe(key, on_batch)

    # -- presence ------------------------------------------------------------------------------------------------

    def _token(self, key: str, alive: bool) -> None:
        self._tell(self.directory.token(key, alive, time.monotonic()))

    def _link(self, up: bool) -> None:
        self.directory.link(up, time.monotonic())
        if up:
            self._robots.repeat_all()
        self._schedule_sweep()

    def _tell(self, changes: list[Change]) -> None:
        gone = [GoneAgent(agent.type, agent.id) for agent, online in changes if not online]
        if gone:
            metadata = Metadata(message_manager=AgentsGone.manager)
            message = encode_message(metadata.encode(), encode_data(AgentsGone(gone)))
            for connection in self._tokens:
                self._call(connection, message)
        for change in changes:
            self._robots.presence(change)
        self._schedule_sweep()

    def _schedule_sweep(self) -> None:
        if self._sweep is not None:
            self._sweep.cancel()
            self._sweep = None
        if (deadline := self.directory.next_deadline()) is not None:
            self._sweep = asyncio.get_running_loop().call_later(
                max(0.0, deadline - time.monotonic()) + 0.01,
                lambda: self._tell(self.directory.tick(time.monotonic())),
            )
