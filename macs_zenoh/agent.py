"""An agent on the mesh: join with type, id and group; send, receive, call, serve, see who is online. Asyncio.

::

    async with macs_zenoh.join("ros", id=7, group=3, connect=["tcp/127.0.0.1:7447"]) as agent:
        agent.send(b"hello", to="unity", ids=[256])
        async for message in agent:
            print(message.sender_type, message.sender_id, message.data)
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from typing import NamedTuple

from msgspec import structs

from . import blocks, keyexpr
from .config import MeshSettings, changed
from .directory import AgentInfo, Change, Directory
from .errors import CallTimeout, OutOfRange, Unreachable, UsageError, WireError
from .keyexpr import BROADCAST, CALL, GROUP, LEASE, PRESENCE, STREAM, type_name, type_number
from .mesh import Mesh, Sample, Subscription, Traffic
from .messages import BROADCAST as EVERYBODY
from .messages import Metadata, NodeType
from .routing import inbox, keys_of, takes_group_copy
from .wire import Layout, encode_frame, encode_message, parse_frame, parse_frames

log = logging.getLogger("macs.agent")

SETTLE_S = 0.3
"""How long a claimed id waits for somebody else's claim on it to show up."""


RETRY_S = 0.05
"""How long a call waits before it asks again an agent that is online and does not serve it yet."""


class Message(NamedTuple):
    """What an agent receives. The sender comes from the key, which a router can hold it to, not from the JSON."""

    sender_type: str
    sender_id: int
    metadata: Metadata
    data: bytes


class Call(NamedTuple):
    """What an agent that serves a verb is asked."""

    verb: str
    sender_type: str
    sender_id: int
    metadata: Metadata
    data: bytes


CallHandler = Callable[[Call], Awaitable[bytes]]
OnPresence = Callable[[AgentInfo, bool], None]


class Agent:
    """One agent. Made by `join`; all methods belong to its event loop, except `publish_stream`.

    ``drops`` counts by name what was lost: ``inbox_full`` (received faster than taken; the oldest goes),
    ``bad_frame``, ``no_destination``, ``unknown_agent`` (sent to an id that is not online).
    """

    INBOX = 4096

    def __init__(self, mesh: Mesh, agent_type: int, group: int) -> None:
        self.mesh = mesh
        self.type_number = agent_type
        self.group = group
        self.id = 0
        self.drops: Counter[str] = Counter()
        self.directory = Directory()
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._stream_keys: dict[str, str] = {}
        self._inbox: deque[Message] = deque()
        self._arrived = asyncio.Event()
        self._closed = False
        self._declared: list[Subscription] = []
        self._on_presence: list[OnPresence] = []
        self._sweep: asyncio.TimerHandle | None = None
        self._warned: set[tuple[int, int]] = set()

    @property
    def type(self) -> str:
        """``ros``, ``unity`` or the type's number as text."""
        return type_name(self.type_number)

    def __repr__(self) -> str:
        return f"<Agent {self.type}/{self.id} group {self.group}>"

    # -- send ----------------------------------------------------------------------------------------------------

    def send(
        self,
        data: bytes,
        *,
        to: str,
        ids: Sequence[int] = (),
        groups: Sequence[int] = (),
        metadata: Metadata | None = None,
    ) -> None:
        """Send to agents of one type (``"ros"``, ``"unity"``), by id, by group or both. Returns at once.

        An agent named by id and by group gets one copy. Raises TooManyDestinations, OutOfRange, UsageError.
        """
        if not ids and not groups:
            raise UsageError("send to whom? give ids or groups, or use broadcast")
        self._send(type_number(to), tuple(ids), tuple(groups), data, metadata)

    def broadcast(self, data: bytes, *, metadata: Metadata | None = None) -> None:
        """Send to every agent of every type, except this one."""
        self._send(EVERYBODY, (), (), data, metadata)

    def publish_stream(self, node: str, frame: bytes) -> None:
        """Put topic data on this agent's stream key, once for all registrants. From any thread.

        ``frame`` is a whole frame whose management data lists who gets it (StreamData).
        """
        key = self._stream_keys.get(node)
        if key is None:
            key = self._stream_keys[node] = STREAM.of(type=self.type_number, id=self.id, node=node)
        self.mesh.put(key, frame, Traffic.STREAM)

    def _send(
        self, to: int, ids: tuple[int, ...], groups: tuple[int, ...], data: bytes, metadata: Metadata | None
    ) -> None:
        stamped = self._stamp(metadata or Metadata())
        frame = encode_frame(to, ids, groups, message=encode_message(stamped.encode(), data), layout=self._layout)
        traffic = Traffic.COMMAND if stamped.node_type == NodeType.PUBLISHER else Traffic.CALL
        for agent_id in ids:
            self._note_unknown(to, agent_id)
        for key in keys_of(self._layout.unpack(frame), self.type_number, self.id):
            self.mesh.put(key, frame, traffic)

    def _stamp(self, metadata: Metadata) -> Metadata:
        """The metadata with its true sender."""
        return structs.replace(metadata, sender_agent_type=self.type_number, sender_agent_id=self.id)

    def _note_unknown(self, agent_type: int, agent_id: int) -> None:
        if (agent_type, agent_id) in self.directory:
            self._warned.discard((agent_type, agent_id))
            return
        self.drops["unknown_agent"] += 1
        if (agent_type, agent_id) not in self._warned:
            self._warned.add((agent_type, agent_id))
            log.warning("%s/%d is not online; messages to it are lost", type_name(agent_type), agent_id)

    # -- receive -------------------------------------------------------------------------------------------------

    async def receive(self) -> Message:
        """The next message sent to this agent's id, its group or everybody. Raises Unreachable once closed."""
        while not self._inbox:
            if self._closed:
                raise Unreachable(repr(self), "it has left the mesh")
            self._arrived.clear()
            await self._arrived.wait()
        return self._inbox.popleft()

    async def __aiter__(self) -> AsyncIterator[Message]:
        """All messages until the agent is closed."""
        while True:
            try:
                yield await self.receive()
            except Unreachable:
                return

    def _receive(self, batch: list[Sample], *, by_group: bool = False) -> None:
        for key, payload in batch:
            try:
                messages = self._read(key, payload, by_group=by_group)
            except WireError as error:
                self.drops["bad_frame"] += 1
                log.warning("a frame on %s cannot be used: %s", key, error)
                continue
            for message in messages:
                if len(self._inbox) >= self.INBOX:
                    self._inbox.popleft()
                    self.drops["inbox_full"] += 1
                self._inbox.append(message)
        self._arrived.set()

    def _read(self, key: str, payload: bytes | bytearray, *, by_group: bool) -> list[Message]:
        parsed = keyexpr.parse(key)
        if parsed is None:
            return []
        plane, fields = parsed
        sender = (int(fields["from_type"]), int(fields["from_id"]))
        if plane == "broadcast" and sender == (self.type_number, self.id):
            return []
        messages = []
        for frame in parse_frames(payload, self._layout):
            if by_group and not takes_group_copy(frame.header, self.id, sender, self.type_number):
                continue
            raw = frame.metadata
            metadata = Metadata.decode(raw) if raw else Metadata()
            messages.append(Message(type_name(sender[0]), sender[1], metadata, bytes(frame.body)))
        return messages

    # -- call and serve ------------------------------------------------------------------------------------------

    async def call(
        self,
        to: str,
        id: int,  # noqa: A002 - what everybody calls it
        verb: str,
        data: bytes = b"",
        *,
        metadata: Metadata | None = None,
        timeout_s: float = 5.0,
    ) -> bytes:
        """Ask one agent to do ``verb`` and return its answer.

        Raises Refused with the other side's reason, Unreachable when it is not there or does not serve the verb,
        CallTimeout.
        """
        kind = type_number(to)
        key = CALL.of(type=kind, id=id, verb=verb, from_type=self.type_number, from_id=self.id)
        message = encode_message(self._stamp(metadata or Metadata()).encode(), data)
        frame = encode_frame(kind, (id,), message=message, layout=self._layout)
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                return await self.mesh.query(key, frame, timeout_s=max(0.001, deadline - time.monotonic()))
            except CallTimeout:
                raise CallTimeout(f"{to}/{id} {verb}", timeout_s) from None
            except Unreachable as error:
                # an agent that has just come is online a moment before it serves
                if (kind, id) not in self.directory or time.monotonic() + RETRY_S > deadline:
                    raise Unreachable(f"{to}/{id} {verb}", error.why) from None
            await asyncio.sleep(RETRY_S)

    def serve(self, verb: str, handler: CallHandler) -> Subscription:
        """Answer calls of ``verb`` with ``await handler(call)``; raise Refused in it to refuse with a reason.

        It takes a moment until the whole mesh knows; callers who see this agent online ask again meanwhile.
        """

        async def answer(key: str, payload: bytes) -> bytes:
            fields = CALL.parse(key)
            if fields is None:
                raise UsageError(f"{key} is not a call")
            frame = parse_frame(payload, self._layout)
            metadata = Metadata.decode(frame.metadata) if frame.metadata else Metadata()
            call = Call(verb, type_name(int(fields["from_type"])), int(fields["from_id"]), metadata, bytes(frame.body))
            return await handler(call)

        return self._keep(self.mesh.serve(CALL.every(type=self.type_number, id=self.id, verb=verb), answer))

    # -- presence ------------------------------------------------------------------------------------------------

    def online(self) -> list[AgentInfo]:
        """Everybody on the mesh now, this agent included, by type and id."""
        return list(self.directory)

    def on_presence(self, callback: OnPresence) -> None:
        """Call ``callback(agent, online)`` when somebody comes, changes group or leaves; now for all who are here."""
        self._on_presence.append(callback)
        for agent in self.directory:
            callback(agent, True)

    def _token(self, key: str, alive: bool) -> None:
        self._tell(self.directory.token(key, alive, time.monotonic()))

    def _link(self, up: bool) -> None:
        self.directory.link(up, time.monotonic())
        self._schedule_sweep()

    def _tell(self, changes: list[Change]) -> None:
        for agent, online in changes:
            if agent.zid != self.mesh.zid:
                log.info("%s/%d %s", agent.type_name, agent.id, "is online" if online else "has left")
            for callback in self._on_presence:
                callback(agent, online)
        self._schedule_sweep()

    def _schedule_sweep(self) -> None:
        if self._sweep is not None:
            self._sweep.cancel()
            self._sweep = None
        if (deadline := self.directory.next_deadline()) is not None:
            delay_s = max(0.0, deadline - time.monotonic())
            self._sweep = asyncio.get_running_loop().call_later(
                delay_s + 0.01, lambda: self._tell(self.directory.tick(time.monotonic()))
            )

    # -- life ----------------------------------------------------------------------------------------------------

    async def _join(self, wanted_id: int | None) -> None:
        self.mesh.on_link(self._link)
        self._keep(self.mesh.watch_tokens(PRESENCE.every(), self._token))
        for key in await self.mesh.tokens(PRESENCE.every()):
            self._token(key, True)
        self._keep(self.mesh.subscribe(BROADCAST.every(), self._receive))
        if self.group:
            members = GROUP.every(group=self.group, type=self.type_number)
            self._keep(self.mesh.subscribe(members, lambda batch: self._receive(batch, by_group=True)))
        if wanted_id is None:
            await self._lease_id()
        else:
            await self._claim_fixed_id(wanted_id)

    async def _claim_fixed_id(self, agent_id: int) -> None:
        if not 1 <= agent_id <= 0xFFFF:
            raise OutOfRange("id", agent_id, 1, 0xFFFF)
        await self._wait_for_stale(agent_id)
        if self.directory.get(self.type_number, agent_id) is not None:
            raise UsageError(f"{self.type}/{agent_id} is already online; choose another id, or leave it out")
        if not await self._claim(agent_id):
            raise UsageError(f"{self.type}/{agent_id} was taken by somebody else in this moment; choose another id")

    async def _wait_for_stale(self, agent_id: int) -> None:
        """Give the token of an earlier life of this agent the time of a lease to end."""
        gone = asyncio.Event()
        stale = (self.type_number, agent_id)
        self.on_presence(lambda agent, online: gone.set() if agent.key == stale and not online else None)
        if stale in self.directory:
            log.info("%s/%d is still online; waiting for it to go", self.type, agent_id)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(gone.wait(), self.mesh.settings.lease_ms / 1000 + 1.0)
        self._on_presence.clear()

    async def _lease_id(self) -> None:
        tried: set[int] = set()
        while True:
            leased = [LEASE.parse(key) for key in await self.mesh.tokens(LEASE.every())]
            taken = tried | {agent.id for agent in self.directory if agent.type == self.type_number}
            held = {int(lease["block"]) for lease in leased if lease} if self.type != "ros" else set()
            agent_id = blocks.free_id(taken, held)
            if agent_id is None:
                raise Unreachable("a free id", f"all ids of type {self.type} are taken")
            if await self._claim(agent_id):
                return
            tried.add(agent_id)

    async def _claim(self, agent_id: int) -> bool:
        """Declare presence under an id and see that nobody with an older right to it did the same at once.

        The inbox comes before the token: whoever sees the agent can reach it.
        """
        self.id = agent_id
        messages = self.mesh.subscribe(inbox(self.type_number, agent_id), self._receive)
        token = self.mesh.declare_token(
            PRESENCE.of(type=self.type_number, id=agent_id, group=self.group, zid=self.mesh.zid)
        )
        await asyncio.sleep(SETTLE_S)
        others = [agent.zid for agent in self.directory.claimants(self.type_number, agent_id)]
        if not blocks.keeps(self.mesh.zid, others):
            token.close()
            messages.close()
            self.id = 0
            return False
        self._keep(messages)
        self._keep(token)
        return True

    def _keep(self, declared: Subscription) -> Subscription:
        self._declared.append(declared)
        return declared

    def close(self) -> None:
        """Leave: the agent is offline at once. The mesh stays open."""
        self._closed = True
        for declared in reversed(self._declared):
            declared.close()
        self._declared.clear()
        if self._sweep is not None:
            self._sweep.cancel()
        self._arrived.set()


@asynccontextmanager
async def join(
    agent_type: str | int,
    *,
    id: int | None = None,  # noqa: A002 - what everybody calls it
    group: int = 0,
    connect: Sequence[str] = (),
    settings: MeshSettings | None = None,
    on_waiting: Callable[[str], None] | None = None,
) -> AsyncIterator[Agent]:
    """Join the mesh as an agent and leave it at the end of the block.

    Args:
        agent_type: ``"ros"``, ``"unity"`` or a number from 1 to 255.
        id: 1 to 65535, unique per type; None takes a free one.
        group: 1 to 255, or 0 for none.
        connect: router endpoints, e.g. ``["tcp/127.0.0.1:7447"]``; several give fail-over.
        settings: everything else about the connection; ``connect``, if given, replaces its endpoints.
        on_waiting: called once with the endpoints while no router answers; it waits as long as it takes.

    Raises:
        UsageError: the id is taken or out of range, the type unknown.
        ConfigError: Zenoh does not accept the settings.
    """
    kind = type_number(str(agent_type))
    if not 0 <= group <= 255:
        raise OutOfRange("group", group, 0, 255)
    settings = settings or MeshSettings()
    if connect:
        settings = changed(settings, connect=list(connect))
    async with await Mesh.open(settings, on_waiting=on_waiting) as mesh:
        agent = Agent(mesh, kind, group)
        try:
            await agent._join(id)
            log.info("joined as %s/%d%s", agent.type, agent.id, f" in group {group}" if group else "")
            yield agent
        finally:
            agent.close()
