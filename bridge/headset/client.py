"""A headset as an asyncio client: it speaks over TCP exactly what the C# Unity program speaks.

::

    async with await Headset.connect("127.0.0.1", 7000, group=3) as headset:
        robots = (await headset.online()).ros_agent_ids
        images = await headset.subscribe("/camera", "sensor_msgs/CompressedImage", agents=robots)
        await headset.publish("/cmd_vel", "geometry_msgs/Twist", cdr, agents=[1])
        answer = await headset.call("/set", "std_srvs/SetBool", 1, request_cdr)
        async for message in images:
            print(message.sender_id, len(message.data))

Messages of ROS are CDR bytes here; `macs_zenoh.typed` turns them into Python and back. One task reads the
socket and never waits for a slow taker: every queue is bounded and counts what it drops. All that a headset can do is
one object in its user's hands, so one class.

Where the C# program is faulty this one is not: it takes groups off groups (the C# sends their numbers as
agents), it survives bad messages (and counts them), it notices the end of a connection, and it can reconnect.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Mapping
from dataclasses import dataclass
from types import TracebackType

import msgspec

from macs_zenoh.errors import CallTimeout, Refused, Unreachable, UsageError, WireError
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.command_clock import NO_CLOCK
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import (
    EVERYBODY,
    EXTENSIONS,
    OTHER_TYPE,
    ROS,
    AccessRefused,
    CommandClock,
    DataRefused,
    Metadata,
    NodeRefused,
    NodeType,
    OnlineReply,
    Refusal,
    SessionOpened,
    SessionResumed,
    Welcome,
    decode_data,
    node_name,
)
from macs_zenoh.protocol.wire import MAX_FRAME_BYTES, split_message
from macs_zenoh.timeouts import within

from . import frames
from .actions import ActionClient
from .connection import Connection
from .frames import DEFAULT_BUFFER_SIZE, NodeSpec
from .mailbox import Mailbox
from .nodes import (
    Incoming,
    Node,
    Publisher,
    Service,
    ServiceClient,
    ServiceHandler,
    Subscription,
)
from .own_clock import OwnClock
from .questions import ROUTER, Questions
from .resumption import ACK_S, Frame, Session, StillMeant, always
from .stream import TCP, Way

log = logging.getLogger("macs.headset")

HANDSHAKE_S = 5.0
"""How long a headset waits for its connection and for the router's first message."""
HEARTBEAT_S = 5.0
"""After so long without other output a headset sends a heartbeat."""
RETRY_S = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Waiting times between attempts to reconnect; the last one repeats."""
INBOX_MESSAGES = 1000
"""How many messages outside interface nodes are held for a taker."""

_OF_SESSIONS = frozenset({SessionOpened.manager, SessionResumed.manager})
_GOODBYE_S = 1.0
_CANCEL_AGAIN_S = 0.5


@dataclass(frozen=True)
class Link:
    """What `Headset.on_link` hears: the connection came up (with this id) or ended (and why)."""

    up: bool
    agent_id: int
    why: str = ""
    resumed: bool = False
    """Whether it is the same agent as before, so that nothing has to be repeated."""


@dataclass(frozen=True)
class Options:
    """What `Headset.connect` takes, and explains."""

    group: int
    reconnect: bool
    handshake_timeout_s: float
    heartbeat_s: float
    max_message_bytes: int
    extensions: int
    token: str | None
    way: Way
    on_link: Callable[[Link], object] | None


class Headset:
    """One headset on one TCP connection to a router or gateway. Made by `connect`."""

    def __init__(self, host: str, port: int, options: Options) -> None:
        self.host = host
        self.port = port
        self.group = options.group
        self.id = 0
        self.bad_messages = 0
        self._options = options
        self._not_let_in = ""
        """Why the gateway does not let this headset in; it makes no sense to come again."""
        self.forbidden: deque[AccessRefused] = deque(maxlen=INBOX_MESSAGES)
        """What its token does not permit, as the gateway has told it."""
        self._nodes: dict[tuple[int, str], Node] = {}
        self._inbox: Mailbox[Incoming] = Mailbox(INBOX_MESSAGES)
        self._connection: Connection | None = None
        self._session: Session | None = None
        """By which it can come back as the same agent, from a gateway that lets it."""
        self._before = 0
        """How many messages of its session had come when its connection began, less those that are not counted."""
        self._acknowledged_at = 0.0
        self._welcome_request = 0
        self._questions = Questions()
        self.clock = OwnClock(self._say_time)
        """By which robots of `tell_times` are told when commands were made."""
        self._reading = asyncio.Event()
        self._reading.set()
        self._ended = asyncio.Event()
        self._why = ""
        self._tasks: list[asyncio.Task[None]] = []

    @classmethod
    async def connect(
        cls,
        host: str,
        port: int,
        *,
        group: int = 0,
        reconnect: bool = False,
        handshake_timeout_s: float = HANDSHAKE_S,
        heartbeat_s: float = HEARTBEAT_S,
        max_message_bytes: int = MAX_FRAME_BYTES,
        extensions: int = EXTENSIONS,
        token: str | None = None,
        way: Way = TCP,
        on_link: Callable[[Link], object] | None = None,
    ) -> Headset:
        """Connect, wait for the router's first message and answer it.

        ``group`` 0 is none. With ``reconnect`` a lost connection is made again and again until `close`; the headset is
        the same agent then, if its gateway still knows it, and otherwise every node is registered anew. The first
        connection is tried once. ``extensions`` is the version of our extensions
        of the protocol that it says it understands; with 0 it is an existing program to its gateway. ``token`` is
        shown to the gateway, and ``way`` says whether that is reached over TLS or WebSocket. ``on_link`` hears every
        start and end.

        Raises Unreachable when there is no connection, or no id as its first message within ``handshake_timeout_s``;
        Refused when the gateway does not take the token.
        """
        options = Options(
            group,
            reconnect,
            handshake_timeout_s,
            heartbeat_s,
            max_message_bytes,
            extensions,
            token,
            way,
            on_link,
        )
        headset = cls(host, port, options)
        await headset._join()
        loop = asyncio.get_running_loop()
        headset._tasks = [loop.create_task(headset._live()), loop.create_task(headset._beat())]
        if token is not None:
            await headset._be_let_in()
        return headset

    async def __aenter__(self) -> Headset:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @property
    def target(self) -> str:
        """``host:port`` of the router."""
        return joined(self.host, self.port)

    @property
    def connected(self) -> bool:
        """Whether there is a configured connection now."""
        return self._connection is not None

    @property
    def reconnecting(self) -> bool:
        """Whether the connection is lost and a new one is being made."""
        return self._connection is None and self._options.reconnect and not self._ended.is_set()

    @property
    def why_ended(self) -> str:
        """Why the headset has ended for good; empty while it has not."""
        return self._why

    @property
    def nodes(self) -> list[Node]:
        """The interface nodes that this headset has asked for."""
        return list(self._nodes.values())

    @property
    def waiting(self) -> int:
        """How many messages outside nodes nobody has taken yet."""
        return len(self._inbox)

    @property
    def dropped(self) -> int:
        """How many messages outside nodes were dropped because nobody took them."""
        return self._inbox.dropped

    # --- what a headset says ---

    async def online(self, timeout_s: float = 5.0) -> OnlineReply:
        """Ask who is online: ids of robots and of headsets. Raises CallTimeout or Unreachable."""
        answer = await self._questions.ask(
            ROUTER,
            lambda number: self.send_frame(
                frames.online_request(self.id, number), lambda: self._questions.waits(ROUTER, number)
            ),
            timeout_s=timeout_s,
            target=f"router {self.target}",
        )
        return decode_data(OnlineReply, answer, ANSWER_BYTES)

    async def ask_gateway(self, manager: str, data: Mapping[str, object], *, timeout_s: float = 5.0) -> bytes:
        """Ask a manager that somebody added to the gateway; returns its answer's data.

        Raises Refused with its reason, or CallTimeout, also when there is no such manager (see the gateway's log).
        """
        answer = await self._questions.ask(
            ROUTER,
            lambda number: self.send_frame(
                frames.management(self.id, number, manager, data), lambda: self._questions.waits(ROUTER, number)
            ),
            timeout_s=timeout_s,
            target=f"{manager} of gateway {self.target}",
        )
        return _not_refused(answer)

    async def subscribe(
        self,
        topic: str,
        data_type: str,
        *,
        agents: Collection[int] = (),
        groups: Collection[int] = (),
        buffer_size: int = DEFAULT_BUFFER_SIZE,
        drop_new: bool = False,
        callback: Callable[[Incoming], object] | None = None,
    ) -> Subscription:
        """Receive a topic of these robots. ``callback`` runs in the reading task; without one, iterate.

        ``buffer_size`` and ``drop_new`` go to robot and gateway and hold for the queue here. Raises UsageError
        when this topic is subscribed already: `Node.register` adds robots to what is there.
        """
        spec = NodeSpec(NodeType.SUBSCRIBER, topic, data_type, buffer_size, drop_new)
        node = Subscription(self, spec, callback)
        self._add(node)
        await node.register(agents=agents, groups=groups)
        return node

    async def advertise(
        self,
        topic: str,
        data_type: str,
        *,
        agents: Collection[int] = (),
        groups: Collection[int] = (),
        buffer_size: int = DEFAULT_BUFFER_SIZE,
        latched: bool = False,
    ) -> Publisher:
        """Ask these robots for a publisher of this topic. A topic advertised already gets the new robots added."""
        node = self._nodes.get((NodeType.PUBLISHER, node_name(topic)))
        if not isinstance(node, Publisher):
            spec = NodeSpec(NodeType.PUBLISHER, topic, data_type, buffer_size, latched=latched)
            node = Publisher(self, spec)
            self._add(node)
        await node.register(agents=agents, groups=groups)
        return node

    async def publish(
        self,
        topic: str,
        data_type: str,
        cdr: bytes,
        *,
        agents: Collection[int] = (),
        groups: Collection[int] = (),
    ) -> None:
        """Publish one message; registers first where that is needed.

        A robot needs a moment to make the publisher and ROS another to find its subscribers, so the very first
        message may find nobody; keep an `advertise`d Publisher where that matters.
        """
        node = await self.advertise(topic, data_type, agents=agents, groups=groups)
        await node.publish(cdr, agents=agents, groups=groups)

    async def call(
        self,
        service: str,
        data_type: str,
        agent: int,
        request: bytes,
        *,
        timeout_s: float = 5.0,
        failures: bool = False,
    ) -> bytes:
        """Call a service that runs on a robot; the response is CDR.

        With ``failures`` the robot is asked to tell why a call failed, which the C# program does not do. Raises
        CallTimeout; Unreachable also when the robot has no such service, or it does not answer; Refused.
        """
        node = self._nodes.get((NodeType.CLIENT, node_name(service)))
        if not isinstance(node, ServiceClient):
            # the C# program asks for dropNew with both kinds of services
            node = ServiceClient(self, NodeSpec(NodeType.CLIENT, service, data_type, drop_new=True))
            self._add(node)
        await node.register(agents=(agent,))
        return await node.call(agent, request, timeout_s, failures=failures)

    async def serve(
        self,
        service: str,
        data_type: str,
        handler: ServiceHandler,
        *,
        agents: Collection[int] = (),
        groups: Collection[int] = (),
    ) -> Service:
        """Run a service for ROS nodes on these robots. ``handler`` takes a request and gives the response's CDR."""
        node = Service(self, NodeSpec(NodeType.SERVICE, service, data_type, drop_new=True), handler)
        self._add(node)
        await node.register(agents=agents, groups=groups)
        return node

    async def action(
        self,
        action: str,
        data_type: str,
        *,
        agents: Collection[int] = (),
        groups: Collection[int] = (),
        buffer_size: int = DEFAULT_BUFFER_SIZE,
    ) -> ActionClient:
        """Register to give goals to an action that runs on these robots; ``buffer_size`` is for feedback."""
        node = self._nodes.get((NodeType.ACTION, node_name(action)))
        if not isinstance(node, ActionClient):
            node = ActionClient(self, NodeSpec(NodeType.ACTION, action, data_type, buffer_size))
            self._add(node)
        await node.register(agents=agents, groups=groups)
        return node

    async def send(
        self,
        data: bytes,
        *,
        to: int = EVERYBODY,
        ids: Collection[int] = (),
        groups: Collection[int] = (),
        manager: str = "",
        request_id: int = 0,
    ) -> None:
        """Send data to agents of type ``to`` (1 robots, 2 headsets, 0 everybody) by id and by group.

        Raises Unreachable, TooManyDestinations or OutOfRange.
        """
        await self.send_frame(
            frames.plain_data(
                self.id, data, to_type=to, ids=ids, groups=groups, manager=manager, request_id=request_id
            ),
            always,
        )

    async def ask(self, robot: int, manager: str, data: bytes = b"", *, timeout_s: float = 5.0) -> bytes:
        """Ask a robot something that is no interface node, and return its answer's data (see docs/robot.md).

        ``manager`` says what: ``FunctionalityGetter``, ``RobotStatus``, ``RobotControl``. Raises CallTimeout,
        Unreachable, or Refused, as when an existing robot program does not know what it is asked.
        """

        def send(number: int) -> Awaitable[None]:
            frame = frames.plain_data(self.id, data, to_type=ROS, ids=(robot,), manager=manager, request_id=number)
            return self.send_frame(frame, lambda: self._questions.waits(robot, number))

        answer = await self._questions.ask(
            robot,
            send,
            timeout_s=timeout_s,
            target=f"{manager} of robot {robot}",
        )
        return _not_refused(answer)

    async def tell_times(
        self, agents: Collection[int], groups: Collection[int] = (), *, timeout_s: float = 2.0
    ) -> set[int]:
        """From now on commands to these robots and groups carry the time at which they were made, so that robots
        refuse those that come late, again or out of order. Waits until the robots know the clock, so long at most, and
        returns those that do: the others are older, or not there. Raises Unreachable."""
        if not (self.clock.robots or self.clock.groups):
            self._tasks.append(asyncio.get_running_loop().create_task(self.clock.keep_known()))
        self.clock.robots.update(agents)
        self.clock.groups.update(groups)
        await self.clock.hello()
        return await self.clock.wait_known(agents, timeout_s)

    def time_of_command(self, agents: Collection[int], groups: Collection[int]) -> tuple[int, str]:
        """What a command to these that is made now carries: the time, and by which clock."""
        return (self.clock.stamp(), self.clock.name) if self.clock.tells(agents, groups) else (0, "")

    async def _say_time(self, data: bytes, robots: Collection[int], groups: Collection[int]) -> None:
        manager = CommandClock.manager
        frame = frames.plain_data(self.id, data, to_type=ROS, ids=robots, groups=groups, manager=manager)
        await self.send_frame(frame)

    async def send_frame(self, frame: bytes, still_meant: StillMeant | None = None) -> None:
        """Send bytes as they are, also what no headset would say; and again if they are lost with the connection, the
        headset comes back as the same agent, and they are ``still_meant`` then. Raises Unreachable without a
        connection."""
        connection = self._connection
        if connection is None or connection.closing:
            raise Unreachable(self.target, self._why or "the connection is lost")
        if self._session is not None:
            self._session.say(frame, still_meant)
        try:
            await connection.send(frame)
        except Unreachable as error:
            raise Unreachable(self.target, self._not_let_in or error.why) from error

    async def set_group(self, group: int) -> None:
        """Move to another group: a second configuration reply on the same connection."""
        self.group = group
        await self.tell(self._configuration)

    # --- what a headset hears ---

    def __aiter__(self) -> Headset:
        return self

    async def __anext__(self) -> Incoming:
        """The next message that belongs to no node and answers no request."""
        return await self._inbox.__anext__()

    async def receive(self, timeout_s: float | None = None) -> Incoming:
        """The next message that belongs to no node and answers no request.

        Raises CallTimeout after ``timeout_s``, Unreachable when the headset is closed and all is taken.
        """
        try:
            return await within(self.__anext__(), timeout_s)
        except asyncio.TimeoutError as error:
            raise CallTimeout(f"a message from {self.target}", timeout_s or 0.0) from error
        except StopAsyncIteration:
            raise Unreachable(self.target, self._why) from None

    def pause(self) -> None:
        """Stop reading the socket, as a headset that renders no frames; heartbeats go on.

        The read that is under way still ends, with at most one more message.
        """
        self._reading.clear()

    def resume(self) -> None:
        """Read again after `pause`."""
        self._reading.set()

    # --- its end ---

    async def wait_ended(self) -> str:
        """Wait until the headset is closed, or has lost its connection for good; tells why."""
        await self._ended.wait()
        return self._why

    async def go_offline(self) -> None:
        """Say that we leave, and close."""
        await self._stop(say_goodbye=True)

    async def close(self) -> None:
        """Go offline if there is a connection, and end every task. Can be called twice."""
        await self._stop(say_goodbye=True)

    async def abort(self) -> None:
        """Vanish without a word, as a headset that lost power."""
        await self._stop(say_goodbye=False)

    def drop_connection(self) -> None:
        """Cut the connection but live on: with ``reconnect`` a new one is made."""
        if self._connection is not None:
            self._connection.abort()

    async def _stop(self, *, say_goodbye: bool) -> None:
        if not self._ended.is_set():
            self._finish("closed here")
        going_on: Collection[asyncio.Task[None]] = self._tasks
        while going_on:
            for task in going_on:
                task.cancel()
            # more than once: before Python 3.12 wait_for may swallow a cancellation, when what it waits for ends then
            _, going_on = await asyncio.wait(going_on, timeout=_CANCEL_AGAIN_S)
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._tasks.clear()
        connection, self._connection = self._connection, None
        if connection is None:
            return
        if not say_goodbye:
            connection.abort()
            return
        with contextlib.suppress(Unreachable, asyncio.TimeoutError):
            await within(connection.send(frames.go_offline(self.id)), _GOODBYE_S)
        await connection.close()

    # --- inside ---

    async def _join(self) -> bool:
        """Have a connection. Whether the headset is the same agent as before on it."""
        connection = await Connection.open(
            self.host,
            self.port,
            timeout_s=self._options.handshake_timeout_s,
            max_message_bytes=self._options.max_message_bytes,
            way=self._options.way,
        )
        former, told = self._session, None
        try:
            first = await connection.receive_first(self._options.handshake_timeout_s)
            metadata, data = split_message(first)
            self._take_id(Metadata.decode(metadata), bytes(data))
            await connection.send(self._configuration(self.id, first=True))
            if former is not None and former.secret:
                told = await self._what_became(connection)
        except WireError as error:
            connection.abort()
            raise Unreachable(self.target, f"its first message gives no id: {error}") from error
        except BaseException:
            connection.abort()
            raise
        resumed = isinstance(told, SessionResumed)
        if former is not None and isinstance(told, SessionResumed):
            self.id = told.agent_id
            await self._say_again(connection, former.resumed(told.received, self.id))
        else:
            self._fail_open(Unreachable(self.target, "its gateway does not know this headset any more"))
            wanted = self._options.reconnect and self._options.extensions > 0
            self._session = Session(told.session if isinstance(told, SessionOpened) else "") if wanted else None
        if self._session is not None:
            self._before = self._session.received - connection.received
        self._connection = connection
        log.info("online at %s with id %d%s", self.target, self.id, ", as before" if resumed else "")
        self._tell_link(Link(True, self.id, resumed=resumed))
        return resumed

    async def _say_again(self, connection: Connection, said: list[Frame]) -> None:
        """Before anything else is said. What is lost once more is in the session by then."""
        if self._session is not None:
            for frame in said:
                self._session.say(*frame)
        for frame in said:
            await connection.send(frame.data)

    async def _what_became(self, connection: Connection) -> SessionResumed | SessionOpened | None:
        """Of the session whose secret was shown, which a gateway says first; None: it knows no sessions. Raises
        Unreachable, WireError."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self._options.handshake_timeout_s
        while True:
            try:
                message = await within(connection.receive(), deadline - loop.time())
            except asyncio.TimeoutError:
                return None
            metadata_json, data = split_message(message)
            manager = Metadata.decode(metadata_json).message_manager
            if manager == SessionResumed.manager:
                return decode_data(SessionResumed, bytes(data))
            if manager == SessionOpened.manager:
                return decode_data(SessionOpened, bytes(data))
            if manager == AccessRefused.manager:
                self._take_access(decode_data(AccessRefused, bytes(data)))

    def _take_session(self, message: Incoming) -> None:
        if message.metadata.message_manager == SessionOpened.manager:
            if self._session is not None:
                self._session.secret = decode_data(SessionOpened, message.data).session
                self._before -= 1
                self._session.received = 0
        elif self._connection is not None:  # it comes too late, when all has been registered anew
            self._connection.abort()

    async def _be_let_in(self) -> None:
        """Wait until the gateway has taken the token. Raises Refused, Unreachable."""
        try:
            await self.online(self._options.handshake_timeout_s)
        except Unreachable:
            await self.abort()
            if self._not_let_in:
                raise Refused(self._not_let_in) from None
            raise
        except BaseException:
            await self.abort()  # nobody else has it yet
            raise

    def _take_id(self, metadata: Metadata, data: bytes) -> None:
        if metadata.message_manager != Welcome.manager:
            raise WireError(f"it is {metadata.message_manager or metadata.node_name!r}, not {Welcome.manager!r}")
        before, self.id = self.id, decode_data(Welcome, data).agent_id
        if before != self.id:
            self.clock.unknown()
        self._welcome_request = metadata.request_id

    def _configuration(self, own_id: int, *, first: bool = False) -> bytes:
        """``first`` on its connection: only there sessions matter."""
        session, received = None, 0
        if first and self._options.reconnect and self._options.extensions > 0:
            former = self._session
            session, received = (former.secret, former.received) if former is not None else ("", 0)
        return frames.configuration(
            own_id,
            self.group,
            self._welcome_request,
            self._options.extensions,
            self._options.token,
            session,
            received,
        )

    async def _live(self) -> None:
        """Read until the end; with ``reconnect`` join again and register everything."""
        while True:
            why = await self._read_to_end()
            if self._connection is not None:
                self._connection.abort()
            self._connection = None
            why = self._not_let_in or why
            if self._session is None or not self._session.secret or self._not_let_in:
                self._fail_open(Unreachable(self.target, why))
            if not self._options.reconnect or self._not_let_in:
                self._finish(why)
                return
            log.warning("connection to %s lost: %s", self.target, why)
            self._tell_link(Link(False, self.id, why))
            await self._rejoin()

    async def _rejoin(self) -> None:
        for attempt in itertools.count():
            try:
                await self._register_all(again=not await self._join())
            except Unreachable as error:
                log.debug("%s", error)
                self.drop_connection()
                self._connection = None
                if self._not_let_in:
                    return
            else:
                return
            await asyncio.sleep(RETRY_S[min(attempt, len(RETRY_S) - 1)])

    async def _register_all(self, *, again: bool) -> None:
        """Whatever has to be said after a reconnection; ``again``: to a gateway that knows nothing of before."""
        for node in self.nodes:
            if again and (node.agents or node.groups):
                agents, groups = sorted(node.agents), sorted(node.groups)
                await self.send_frame(frames.registration(self.id, node.spec, agents, groups), always)
            if isinstance(node, ActionClient):
                await node.ask_again()

    async def _read_to_end(self) -> str:
        connection = self._connection
        if connection is None:
            return "no connection"
        try:
            while True:
                await self._reading.wait()
                raw = await connection.receive()
                if self._session is not None:
                    self._session.received = self._before + connection.received
                try:
                    await self._take(raw)
                except WireError as error:
                    self.bad_messages += 1
                    log.warning("a bad message from %s: %s", self.target, error)
        except Unreachable as error:
            return error.why
        except WireError as error:  # framing is lost
            return str(error)

    async def _take(self, raw: bytes) -> None:
        metadata_json, data = split_message(raw)
        message = Incoming(Metadata.decode(metadata_json), bytes(data))
        metadata = message.metadata
        if metadata.node_name:  # receivers look at the node's name first: topic data also names a manager
            mailbox = self._take_node_message(message)
        elif metadata.message_manager == Welcome.manager:
            self._take_id(metadata, message.data)
            await self.send_frame(self._configuration(self.id))
            return
        elif not metadata.message_manager and self._questions.take(message):
            return
        elif metadata.message_manager == CommandClock.manager and message.sender_type == ROS:
            await self.clock.take(message.sender_id or 0, message.data)
            return
        elif metadata.message_manager in _OF_SESSIONS and message.sender_type is None:
            self._take_session(message)
            return
        else:
            self._take_refusal(message)
            mailbox = self._inbox
        if mailbox is not None:
            await mailbox.offer(message)

    def _take_refusal(self, message: Incoming) -> None:
        """Tell the node that a robot, or its gateway, refused it or what was sent for it."""
        refused: NodeRefused | DataRefused
        by_gateway = message.sender_type is None
        if message.metadata.message_manager == AccessRefused.manager and by_gateway:
            self._take_access(decode_data(AccessRefused, message.data))
            return
        if message.metadata.message_manager == NodeRefused.manager:
            refused = decode_data(NodeRefused, message.data)
        elif message.metadata.message_manager == DataRefused.manager and by_gateway:
            refused = decode_data(DataRefused, message.data)  # for robots to which it passes nothing on
        elif message.metadata.message_manager == DataRefused.manager and message.sender_type == ROS:
            refused = msgspec.structs.replace(decode_data(DataRefused, message.data), robot_id=message.sender_id or 0)
            if refused.kind == NO_CLOCK:
                self.clock.unknown(refused.robot_id)
        else:
            return
        node = self._nodes.get((refused.node_type, refused.node_name))
        if node is not None:
            for robot in [refused.robot_id] if refused.robot_id else sorted(node.agents) or [0]:
                node.refused(robot, refused.reason, final=_is_final(refused))
        else:
            about = refused.tos_name or refused.node_name
            log.warning("robot %d refused %s: %s", refused.robot_id, about, refused.reason)

    def _take_node_message(self, message: Incoming) -> Mailbox[Incoming] | None:
        node = self._nodes.get((message.metadata.node_type, message.metadata.node_name))
        if node is None:
            return self._inbox
        if message.sender_type != ROS:
            raise WireError(f"data for {node.spec.tos_name} from agent type {message.sender_type}, not a robot")
        return node.receive(message)

    def _take_access(self, refused: AccessRefused) -> None:
        """What the gateway does not permit."""
        if refused.kind in ("no_token", "ended"):
            self._not_let_in = refused.reason
        log.warning("%s: %s", self.target, refused.reason)
        if refused.kind == "not_permitted":
            self.forbidden.append(refused)
            self._questions.refuse(refused.request_id, refused.reason)

    async def _beat(self) -> None:
        loop, heartbeat_s = asyncio.get_running_loop(), self._options.heartbeat_s
        while True:
            connection, session = self._connection, self._session
            if session is not None and not session.secret:
                session = None  # its gateway knows none, and need not be told what has come
            due_s = heartbeat_s if connection is None else connection.last_output + heartbeat_s - loop.time()
            if session is not None and session.received > session.told:
                due_s = min(due_s, self._acknowledged_at + ACK_S - loop.time())
            if due_s > 0 or connection is None:
                await asyncio.sleep(due_s if session is None else min(max(due_s, 0.05), ACK_S))
                continue
            try:
                if session is None:
                    await self.send_frame(frames.heartbeat())
                    continue
                session.told, self._acknowledged_at = session.received, loop.time()
                await self.send_frame(frames.heartbeat(session.told))
            except Unreachable:
                await asyncio.sleep(heartbeat_s)  # the reading task sees the end as well

    async def tell(self, frame: Callable[[int], bytes]) -> None:
        """Send what a reconnection would repeat anyway: without a connection it waits for that."""
        if self.reconnecting:
            if self._session is not None:
                self._session.say_later(frame)
            return
        await self.send_frame(frame(self.id), always)

    def _add(self, node: Node) -> None:
        key = (node.spec.kind, node.spec.name)
        taken = self._nodes.get(key)
        if taken is not None:
            raise UsageError(f"{node.spec.tos_name}: there is a node of this kind for {taken.spec.tos_name}")
        self._nodes[key] = node

    def forget(self, node: Node) -> None:
        self._nodes.pop((node.spec.kind, node.spec.name), None)
        node.end()

    def _fail_open(self, error: Unreachable) -> None:
        self._questions.fail(error)
        for node in self.nodes:
            if isinstance(node, ServiceClient):
                node.fail(error)

    def _finish(self, why: str) -> None:
        self._why = why
        self._ended.set()
        self._fail_open(Unreachable(self.target, why))
        self._inbox.close()
        for node in self.nodes:
            node.end()
        log.info("offline: %s", why)
        self._tell_link(Link(False, self.id, why))

    def _tell_link(self, link: Link) -> None:
        if self._options.on_link is None:
            return
        try:
            self._options.on_link(link)
        except Exception:  # our caller's code must not end our tasks
            log.exception("on_link failed")


def _not_refused(answer: bytes) -> bytes:
    """An answer to a plain request. Raises Refused when it says why there is none."""
    if answer.startswith(b'{"refused"'):
        raise Refused(decode_data(Refusal, answer).refused)
    return answer


def _is_final(refused: NodeRefused | DataRefused) -> bool:
    """Whether it is the node that is refused, not only something that was sent for it."""
    return isinstance(refused, NodeRefused) or refused.kind == OTHER_TYPE
