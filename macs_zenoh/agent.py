"""An agent on the mesh: send, receive, call, serve, see who is online. Asyncio. It is made by `joining.join`."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from functools import partial
from typing import Any, overload

from .errors import CallTimeout, Closed, Unreachable, UsageError, WireError
from .handles import Callbacks, Handle
from .identity import Identity
from .losses import Losses
from .mesh import Aged, Mesh, Sample, Subscription, Traffic
from .nodes import ANSWER_S, Nodes
from .presence import Presence
from .presses import REPLACES, STOP_NAME, WAITS, WAITS_INSTEAD, Presses
from .protocol.agent_id import AgentId
from .protocol.directory import AgentInfo, Change, Directory
from .protocol.guard import Guard
from .protocol.keyexpr import BROADCAST, GROUP, type_name, type_number
from .protocol.limits import CALL_BYTES
from .protocol.messages import EVERYBODY, Metadata, NodeType
from .protocol.reading import Message, Reader
from .protocol.routing import call, inbox, keys_of
from .protocol.wire import Layout, encode_frame, encode_message
from .serving import Call, CallFirst, CallHandler, Served
from .topics import DEPTH, Chosen, NodeUser, TopicPublisher, TopicSubscription, Value

log = logging.getLogger("macs.agent")

RETRY_S = 0.05
"""How long a call waits before it asks again an agent that is online and does not serve it yet."""


OnMessage = Callable[[Message], None]
OnPresence = Callable[[AgentInfo, bool], None]
OnAsleep = Callable[[AgentInfo], None]
OnId = Callable[[int, int], None]


class Agent:
    """One agent. Made by `join`; all methods belong to its event loop.

    ``drops`` counts by name what was lost: ``inbox_full`` (received faster than taken; the oldest goes),
    ``bad_frame``, ``no_destination``, ``unknown_agent`` (sent to an id that is not online), ``too_old`` (a release of
    an emergency stop that waited until the stop was answered, and had been replaced by then).
    """

    INBOX = 4096

    def __init__(self, mesh: Mesh, agent_type: int, group: int, guard: Guard | None = None) -> None:
        self.mesh = mesh
        self._guard = guard
        self.type_number = agent_type
        self.group = group
        self.id = 0
        self.drops = Losses(log)
        self._presence = Presence(mesh, self._presence_changed, lambda contested: self._identity.contested(contested))
        self._identity = Identity(mesh, self._presence, agent_type, group, listen=self._listen, on_id=self._id_changed)
        self._presses = Presses(mesh, self._presence.directory)
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._reader = Reader(self._layout, self._bad_frame)
        self._inbox: deque[Message] = deque()
        self._arrived = asyncio.Event()
        self._on_message: OnMessage = self._keep_message
        self._closed = False
        self._declared: list[Subscription] = []
        self._on_presence: Callbacks[OnPresence] = Callbacks()
        self._on_asleep: Callbacks[OnAsleep] = Callbacks()
        self._on_id: Callbacks[OnId] = Callbacks()
        self._served = Served(self._layout, lambda: self.key, guard)
        self._warned: set[tuple[int, int]] = set()
        self._nodes: Nodes | None = None
        """What it uses of robots, once it does."""

    @property
    def type(self) -> str:
        """``ros``, ``unity`` or the type's number as text."""
        return type_name(self.type_number)

    @property
    def key(self) -> AgentId:
        """What identifies it: type and id."""
        return AgentId(self.type_number, self.id)

    @property
    def directory(self) -> Directory:
        """Who is online."""
        return self._presence.directory

    def __repr__(self) -> str:
        return f"<Agent {self.key} group {self.group}>"

    # -- send ----------------------------------------------------------------------------------------------------

    def send(
        self,
        data: bytes,
        *,
        to: str | int,
        ids: Sequence[int] = (),
        groups: Sequence[int] = (),
        metadata: Metadata | None = None,
    ) -> None:
        """Send to agents of one type (``"ros"``, ``"unity"`` or its number), by id, by group or both.

        Returns at once; `drain` waits. What is under way when a link is lost does not arrive: use `call`, which is
        answered, where that matters. An agent named by id and by group gets one copy. Raises
        TooManyDestinations, OutOfRange, UsageError, Closed.
        """
        if not ids and not groups:
            raise UsageError("send to whom? give ids or groups, or use broadcast")
        self._send(type_number(to), tuple(ids), tuple(groups), data, metadata)

    def reply(self, message: Message, data: bytes, *, metadata: Metadata | None = None) -> None:
        """Send to the sender of ``message``, with its request id, so that it knows what is answered."""
        metadata = metadata or Metadata(request_id=message.metadata.request_id)
        self.send(data, to=message.sender_type, ids=[message.sender_id], metadata=metadata)

    def broadcast(self, data: bytes, *, metadata: Metadata | None = None) -> None:
        """Send to every agent of every type, except this one."""
        self._send(EVERYBODY, (), (), data, metadata)

    async def drain(self) -> None:
        """Wait until all that was sent is in the hands of Zenoh, which sends it before the agent leaves the mesh.

        To send much, wait after each piece: `send` returns at once, and beyond a limit what waits is lost, and counted
        by the mesh as ``backlog``.
        """
        self._check_open()
        await self.mesh.drain()

    def _send(
        self, to: int, ids: tuple[int, ...], groups: tuple[int, ...], data: bytes, metadata: Metadata | None
    ) -> None:
        self._check_open()
        check_bytes(data)
        stamped = self._stamp(metadata or Metadata())
        frame = encode_frame(to, ids, groups, message=encode_message(stamped.encode(), data), layout=self._layout)
        traffic = Traffic.COMMAND if stamped.node_type == NodeType.PUBLISHER else Traffic.CALL
        for agent_id in ids:
            self._note_unknown(to, agent_id)
        header = self._layout.unpack(frame)
        keys = keys_of(header, self.type_number, self.id)
        if traffic is Traffic.COMMAND and stamped.node_name == STOP_NAME:
            put = partial(self._put, keys, frame, traffic)
            looked = self._presses.look(self.key, header, bytes(data[:5]), put)
            if looked in (REPLACES, WAITS_INSTEAD):
                self.drops["too_old"] += 1
            if looked in (WAITS, WAITS_INSTEAD):
                return
        self._put(keys, frame, traffic)

    def _put(self, keys: list[str], frame: bytes, traffic: Traffic) -> None:
        for key in keys:
            self.mesh.put(key, frame, traffic)

    def _stamp(self, metadata: Metadata) -> Metadata:
        """The metadata with its true sender."""
        return metadata.sent_by(self.type_number, self.id)

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
        """The next message sent to this agent's id, its group or everybody. Raises Closed once the agent is closed."""
        while not self._inbox:
            self._check_open()
            self._arrived.clear()
            await self._arrived.wait()
        return self._inbox.popleft()

    async def __aiter__(self) -> AsyncIterator[Message]:
        """All messages until the agent is closed."""
        while True:
            try:
                yield await self.receive()
            except Closed:
                return

    def on_message(self, handler: OnMessage) -> Handle:
        """Pass messages to ``handler``, on the loop, instead of keeping them for `receive`; it should not raise.

        There is one handler at a time; a new one takes its place. When the handle is closed, messages are kept again.
        """
        self._on_message = handler
        while self._inbox:
            handler(self._inbox.popleft())

        def end() -> None:
            if self._on_message is handler:
                self._on_message = self._keep_message

        return Handle(end)

    def _keep_message(self, message: Message) -> None:
        if len(self._inbox) >= self.INBOX:
            self._inbox.popleft()
            self.drops["inbox_full"] += 1
        self._inbox.append(message)
        self._arrived.set()

    def _receive(self, batch: Iterator[Sample], *, by_group: bool = False) -> None:
        me = (self.type_number, self.id)
        for key, payload in batch:
            for message in self._reader.read(key, payload, me, by_group=by_group):
                if self._nodes is None or not self._nodes.take(message):
                    self._on_message(message)

    def _receive_judged(self, batch: Iterator[Aged], *, guard: Guard, by_group: bool = False) -> None:
        me = (self.type_number, self.id)
        for key, payload, age_s, now in batch:
            messages = self._reader.read(key, payload, me, by_group=by_group)
            for message in guard.covered(key, len(payload), messages, now):
                judged = guard.judge(message, key, age_s, now)
                if judged is not None and (self._nodes is None or not self._nodes.take(judged)):
                    self._on_message(judged)

    def _subscribe(self, key: str, *, by_group: bool = False) -> Subscription:
        """Receive what comes on a key."""
        if self._guard is None:
            return self.mesh.subscribe(key, partial(self._receive, by_group=by_group))
        judged = partial(self._receive_judged, guard=self._guard, by_group=by_group)
        return self.mesh.subscribe_guarded(key, judged, self._guard)

    def _bad_frame(self, key: str, error: WireError) -> None:
        self.drops.once("bad_frame", "a frame on %s cannot be used: %s", key, error)

    # -- call and serve ------------------------------------------------------------------------------------------

    async def call(
        self,
        to: str | int,
        id: int,  # noqa: A002 - what everybody calls it
        verb: str,
        data: bytes = b"",
        *,
        metadata: Metadata | None = None,
        timeout_s: float = 5.0,
    ) -> bytes:
        """Ask one agent to do ``verb`` and return its answer.

        Raises Refused with the other side's reason, Unreachable when it is not there or does not serve the verb,
        CallTimeout, which is a TimeoutError, UsageError, Closed.
        """
        self._check_open()
        check_bytes(data)
        kind = type_number(to)
        target = f"{AgentId(kind, id)} {verb}"
        stamped = self._stamp(metadata or Metadata())
        key, frame = call((kind, id), verb, (self.type_number, self.id), data, stamped, self._layout)
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                return await self.mesh.query(key, frame, timeout_s=max(0.001, deadline - time.monotonic()))
            except CallTimeout:
                raise CallTimeout(target, timeout_s) from None
            except Unreachable as error:
                # an agent that has just come is online a moment before it serves
                if (kind, id) not in self.directory or time.monotonic() + RETRY_S > deadline:
                    raise Unreachable(target, error.why) from None
            await asyncio.sleep(RETRY_S)

    def serve(
        self,
        verb: str,
        handler: CallHandler,
        *,
        first: CallFirst | None = None,
        stand_in: bool = False,
        mesh: Mesh | None = None,
        most_bytes: int | None = None,
    ) -> Handle:
        """Answer calls of ``verb`` with ``await handler(call)``, until the handle is closed; it may raise Refused.

        ``first(call)`` is called before that, in a thread of Zenoh's, even while the loop is busy; it may refuse. With
        ``mesh`` another session answers for this agent; with ``stand_in`` this one answers only while no other session
        does. What brings more than ``most_bytes`` (with ``first``: `CALL_BYTES`) is refused unread. The whole mesh
        knows of it a moment later; callers who see this agent online ask again until then.
        """
        self._check_open()
        return self._served.add(
            verb, handler, first=first, stand_in=stand_in, mesh=mesh or self.mesh, most_bytes=most_bytes
        )

    # -- what robots have ----------------------------------------------------------------------------------------

    async def subscribe(
        self,
        topic: str,
        *,
        robot: Chosen = (),
        group: Chosen = (),
        type: str | None = None,  # noqa: A002 - what everybody calls it
        depth: int = DEPTH,
        timeout_s: float = ANSWER_S,
    ) -> TopicSubscription:
        """Receive a topic of robots, until the subscription is closed, as a headset does.

        Args:
            topic: its name on the robot, as ``/pose``.
            robot: the id of a robot, or several.
            group: all robots of a group, or of several.
            type: as ``geometry_msgs/PoseStamped``; without one, what the robots that are online call it.
            depth: how many messages the robot holds, and this subscription, while they are not taken.
            timeout_s: how long the robots may take to answer.

        It holds for robots that come later or come back as well. Several subscriptions of one topic share what goes
        over the mesh. What a latched topic holds comes to each of them: to later ones what the first have had, up to
        ``depth`` messages.

        Raises Refused with the robot's reason when none of those online lets it, CallTimeout, Unreachable when no
        robot tells its type, UsageError, Closed.
        """
        return await self._robot_nodes().subscribe(topic, robot, group, type, depth, timeout_s)

    async def advertise(
        self,
        topic: str,
        *,
        robot: Chosen = (),
        group: Chosen = (),
        type: str | None = None,  # noqa: A002
        timeout_s: float = ANSWER_S,
    ) -> TopicPublisher:
        """Be able to publish to a topic of robots, until the publisher is closed.

        Parameters and errors are those of `subscribe`.
        """
        return await self._robot_nodes().advertise(topic, robot, group, type, timeout_s)

    async def publish(
        self,
        topic: str,
        data: bytes | Value,
        *,
        robot: Chosen = (),
        group: Chosen = (),
        type: str | None = None,  # noqa: A002
        timeout_s: float = ANSWER_S,
    ) -> None:
        """Publish one message, as CDR or as a value, to a topic of robots: it may move them.

        It stays advertised until the agent is closed; `advertise` gives more say. Of those that wait for that only the
        newest is sent (``too_old``). Raises what `subscribe` raises, and MissingExtra, UnknownType and BadValue.
        """
        await self._robot_nodes().publish(topic, data, robot, group, type, timeout_s)

    @overload
    async def call_service(
        self, service: str, request: bytes, *, robot: int, type: str | None = None, timeout_s: float = ANSWER_S
    ) -> bytes: ...

    @overload
    async def call_service(
        self, service: str, request: Value, *, robot: int, type: str | None = None, timeout_s: float = ANSWER_S
    ) -> dict[str, Any]: ...

    async def call_service(
        self,
        service: str,
        request: bytes | Value,
        *,
        robot: int,
        type: str | None = None,  # noqa: A002
        timeout_s: float = ANSWER_S,
    ) -> bytes | dict[str, Any]:
        """Call a service that runs on a robot: CDR for CDR, a value for a value.

        Raises Refused with the reason of the robot or the service, Unreachable when it is not there, CallTimeout,
        UsageError, Closed, and what cannot be written or read: MissingExtra, UnknownType, BadValue, BadCdr.
        """
        answer: bytes | dict[str, Any] = await self._robot_nodes().call(service, request, robot, type, timeout_s)
        return answer

    async def use_action(
        self,
        action: str,
        *,
        robot: int,
        type: str,  # noqa: A002
        timeout_s: float = ANSWER_S,
    ) -> NodeUser:
        """Have a robot take goals for an action, until what is returned is closed. Goals and what is told of them are
        messages (docs/actions.md): `send` and `on_message`.

        Raises Refused with the robot's reason, CallTimeout, UsageError, Closed.
        """
        return await self._robot_nodes().use_action(action, type, robot, timeout_s)

    def _robot_nodes(self) -> Nodes:
        self._check_open()
        if self._nodes is None:
            self._nodes = Nodes(self, self._layout)
        return self._nodes

    # -- presence ------------------------------------------------------------------------------------------------

    def online(self) -> list[AgentInfo]:
        """Everybody on the mesh now, this agent included, by type and id."""
        return list(self.directory)

    def on_presence(self, callback: OnPresence) -> Handle:
        """Call ``callback(agent, online)`` when somebody comes, changes group or leaves; now for all who are here."""
        handle = self._on_presence.add(callback)
        for agent in self.directory:
            callback(agent, True)
        return handle

    def on_asleep(self, callback: OnAsleep) -> Handle:
        """Call ``callback(agent)`` when the connection of a headset has ended that may come back as the same agent
        (``agent.asleep``), and when it has. Meanwhile it counts as online; what it was moving has to stop."""
        return self._on_asleep.add(callback)

    def on_id(self, callback: OnId) -> Handle:
        """Call ``callback(old, new)`` when the id has had to change; then ``id`` is the new one already.

        That happens when two parts of a mesh meet and an agent in each had taken the same free id. What this agent
        receives, serves and sends goes on under the new id. What others registered here was for the old one, which is
        somebody else's now.
        """
        return self._on_id.add(callback)

    def _presence_changed(self, changes: list[Change]) -> None:
        for change in changes:
            agent, online, same = change
            if same:
                for told in self._on_asleep:
                    _contained(f"telling of {agent.type_name}/{agent.id}", told, agent)
                continue
            if self._nodes is not None:
                _contained("what follows for interface nodes", self._nodes.presence, change)
            if agent.zid != self.mesh.zid:
                log.info("%s/%d %s", agent.type_name, agent.id, "is online" if online else "has left")
            for callback in self._on_presence:
                _contained(f"telling of {agent.type_name}/{agent.id}", callback, agent, online)

    def _id_changed(self, old: int, new: int) -> None:
        self._presses.leave(AgentId(self.type_number, old))
        self.id = new
        self._served.renew()
        if self._nodes is not None:
            self._nodes.id_changed((self.type_number, old), new)
        for callback in self._on_id:
            _contained(f"handling the new id of {self.type}/{new}", callback, old, new)

    def show(self, there: bool) -> None:
        """Be offline to others, or online again, with all that is registered and served here."""
        (self._identity.show if there else self._identity.hide)()

    # -- life ----------------------------------------------------------------------------------------------------

    async def _join(self, wanted_id: int | None) -> None:
        self._keep(self.mesh.answer_pings())
        await self._presence.start()
        self._keep(self._subscribe(BROADCAST.every()))
        if self.group:
            self._keep(self._subscribe(GROUP.every(group=self.group, type=self.type_number), by_group=True))
        self.id = await self._identity.take(wanted_id)
        self.serve("ping", _echo, most_bytes=CALL_BYTES)

    def _listen(self, agent_id: int) -> Subscription:
        if self._guard is not None:
            self._guard.me = (self.type_number, agent_id)
        return self._subscribe(inbox(self.type_number, agent_id))

    def _keep(self, declared: Subscription) -> Subscription:
        self._declared.append(declared)
        return declared

    def _check_open(self) -> None:
        if self._closed:
            raise Closed(str(self.key))

    def close(self) -> None:
        """Leave: the agent is offline at once. The mesh stays open."""
        self._closed = True
        if self._nodes is not None:
            self._nodes.close()
        self._presses.close()
        self._identity.close()
        self._served.close()
        for declared in reversed(self._declared):
            declared.close()
        self._declared.clear()
        self._presence.close()
        self._arrived.set()


def check_bytes(data: object) -> None:
    """Raise UsageError for what is no bytes, text above all."""
    if isinstance(data, str):
        raise UsageError("data is bytes, not text: write text.encode(), and data.decode() on the other side")
    if not isinstance(data, bytes | bytearray | memoryview):
        raise UsageError(f"data is bytes, not {type(data).__name__}")


async def _echo(call: Call) -> bytes:
    """The call ``ping``: whoever gets this answer may call this agent."""
    return call.data


def _contained(what: str, callback: Callable[..., object], *args: object) -> None:
    """One that fails keeps no other from hearing, nor anybody from hearing of the others who came or left."""
    try:
        callback(*args)
    except Exception:
        log.exception("%s failed", what)
