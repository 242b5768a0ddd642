"""What an agent uses of robots, as a headset does: topics, to receive and to publish, and services. Asyncio.

A robot is asked for an interface node. Several users of one in a program share its registration, which is repeated
when the robot comes back. The data is CDR; typed values need `rosbags` (``pip install 'macs-zenoh[headset]'``).
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from msgspec import structs

from .errors import CallTimeout, Closed, MacsError, Refused, Unreachable, UsageError, WireError
from .late import Late
from .mesh import Sample
from .mesh import Subscription as Declared
from .protocol.directory import Change
from .protocol.keyexpr import STREAM
from .protocol.limits import ANSWER_BYTES
from .protocol.messages import (
    ROS,
    AddNode,
    CallFailure,
    DataRefused,
    Functionality,
    Metadata,
    NodeRefused,
    NodeType,
    RemoveNode,
    decode_data,
    node_name,
)
from .protocol.offers import short_type, type_behind
from .protocol.reading import Message
from .protocol.registrations import AgentKey, NodeKey, Task
from .protocol.stream_reading import StreamReader
from .protocol.wire import Layout
from .registration_calls import RobotCalls, StreamChanges
from .timeouts import Deadline, within
from .topics import (
    DEPTH,
    Chosen,
    Node,
    NodeUser,
    ServiceUser,
    TopicMessage,
    TopicPublisher,
    TopicSubscription,
    Value,
    chosen,
    is_cdr,
    is_other,
    value_of,
)
from .typed import Types, request_of, response_of

if TYPE_CHECKING:
    from .agent import Agent

log = logging.getLogger("macs.agent")

ANSWER_S = 5.0
"""How long a robot may take to answer a registration or a call."""
REQUEST_IDS = 1 << 31
"""The C# program counts in an int."""
KNOWN = 1024
"""How many refusals are remembered as logged: their reasons come from the network."""


User = TypeVar("User", bound=NodeUser)
Published = tuple[str, frozenset[int], frozenset[int]]
"""A topic, robots and groups."""
Asked = tuple[str, frozenset[int], frozenset[int], str | None]
"""The same with a type."""


class Nodes:
    """The interface nodes that one agent uses. Made when it uses the first."""

    def __init__(
        self,
        agent: Agent,
        layout: Layout,
        *,
        patient: bool = False,
        on_count: Callable[[str, bytes], None] = lambda key, data: None,
    ) -> None:
        """``patient``: topics may come a hundredth of a second later, which costs less. ``on_count(key, data)``: how
        much a robot has put for this agent, where it was asked to tell (`StreamCount`)."""
        self.agent = agent
        self._patient = patient
        self._nodes: dict[NodeKey, Node] = {}
        self._streams: dict[tuple[int, str], Declared] = {}
        self._reader = StreamReader(layout, self._bad_frame, on_count)
        self._types: Types | None = None
        self._services: dict[tuple[str, int], ServiceUser] = {}
        self._publishers: dict[Published, TopicPublisher] = {}
        self._registering: dict[Asked, asyncio.Task[TopicPublisher]] = {}
        self._newest: dict[Published, int] = {}
        """How many messages `publish` was given: of those that wait only the newest is sent."""
        self._next_request = itertools.count().__next__
        self._open: dict[tuple[int, str, int], asyncio.Future[bytes]] = {}
        """Calls by robot, node name and request id."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._logged: set[tuple[NodeKey, int, str]] = set()
        self._closed = False
        self._late = Late(agent)
        self._calls = RobotCalls(
            agent.mesh,
            agent.directory,
            layout,
            on_streams=self._streams_changed,
            on_refused=self._node_refused,
            on_done=self._confirmed,
        )
        self._following = agent.mesh.on_link(lambda up: self._calls.repeat_all() if up else None)
        for robot in agent.directory.of_type(ROS):
            self._calls.presence(Change(robot, online=True))

    def types(self) -> Types:
        """Definitions of messages, loaded when the first is needed. Raises MissingExtra."""
        if self._types is None:
            self._types = Types()
        return self._types

    # -- use -----------------------------------------------------------------------------------------------------

    async def subscribe(
        self, topic: str, robot: Chosen, group: Chosen, of_type: str | None, depth: int, timeout_s: float
    ) -> TopicSubscription:
        """See `Agent.subscribe`."""
        if depth < 1:
            raise UsageError("a depth of at least 1 message is needed")
        robots, groups = chosen(robot, group)
        until = Deadline(timeout_s)
        node = await self._node(NodeType.SUBSCRIBER, topic, of_type, robots, groups, until)
        subscription = TopicSubscription(self, node, robots, groups, depth)
        before = self._late.before(node, self._online(robots, groups), depth)
        await self._use(subscription, node, until, depth)  # from its beginning on it hears what comes
        try:
            await self._late.give(subscription, node, before, until)
        except BaseException:
            subscription.close()
            raise
        return subscription

    async def advertise(
        self, topic: str, robot: Chosen, group: Chosen, of_type: str | None, timeout_s: float
    ) -> TopicPublisher:
        """See `Agent.advertise`."""
        robots, groups = chosen(robot, group)
        until = Deadline(timeout_s)
        node = await self._node(NodeType.PUBLISHER, topic, of_type, robots, groups, until)
        return await self._use(TopicPublisher(self, node, robots, groups), node, until)

    async def publish(
        self, topic: str, data: bytes | Value, robot: Chosen, group: Chosen, of_type: str | None, timeout_s: float
    ) -> None:
        """See `Agent.publish`."""
        key = (topic, *chosen(robot, group))
        number = self._newest[key] = self._newest.get(key, 0) + 1
        publisher = self._publishers.get(key)
        if publisher is None or is_other(of_type, publisher):
            publisher = await self._advertised((*key, of_type), key, timeout_s)
            if number != self._newest[key]:  # a newer one may have gone out already
                self.agent.drops.note("too_old", topic, "waited for its registration while a newer message came")
                return
        publisher.publish(data)

    async def _advertised(self, asked: Asked, key: Published, timeout_s: float) -> TopicPublisher:
        """The publisher of `publish`, with one registration for all that wait for it."""
        registering = self._registering.get(asked)
        if registering is None:
            former = self._publishers.pop(key, None)
            if former is not None:
                former.close()
            registering = asyncio.ensure_future(self.advertise(asked[0], asked[1], asked[2], asked[3], timeout_s))
            self._registering[asked] = registering
            registering.add_done_callback(lambda done: self._has_advertised(asked, key, done))
            return await asyncio.shield(registering)
        try:
            return await within(asyncio.shield(registering), timeout_s)
        except asyncio.TimeoutError as error:
            raise CallTimeout(f"registration of {asked[0]}", timeout_s) from error

    def _has_advertised(self, asked: Asked, key: Published, done: asyncio.Task[TopicPublisher]) -> None:
        del self._registering[asked]
        if done.cancelled() or done.exception() is not None:
            return
        former = self._publishers.get(key)
        if former is not None:
            former.close()
        self._publishers[key] = done.result()

    async def call(
        self, service: str, request: bytes | Value, robot: int, of_type: str | None, timeout_s: float
    ) -> Any:
        """See `Agent.call_service`."""
        until = Deadline(timeout_s)
        robots, groups = chosen(robot, ())
        if (ROS, robot) not in self.agent.directory:
            raise Unreachable(f"ros/{robot}", "it is not online")
        user = self._services.get((service, robot))
        if user is None or user.refused or is_other(of_type, user):
            if user is not None:
                user.close()
            node = await self._node(NodeType.CLIENT, service, of_type, robots, groups, until)
            user = await self._use(ServiceUser(self, node, robots, groups), node, until)
            self._services[service, robot] = user
        if is_cdr(request):
            return await self._ask(user, robot, request, until)
        cdr = self.types().serialize(request_of(user.type), value_of(request))
        answer = await self._ask(user, robot, cdr, until)
        return self.types().deserialize(response_of(user.type), answer)

    async def use_action(self, action: str, of_type: str, robot: int, timeout_s: float) -> NodeUser:
        """See `Agent.use_action`."""
        robots, groups = chosen(robot, ())
        until = Deadline(timeout_s)
        node = await self._node(NodeType.ACTION, action, of_type, robots, groups, until)
        return await self._use(NodeUser(self, node, robots, groups), node, until)

    async def _ask(self, user: ServiceUser, robot: int, request: bytes, until: Deadline) -> bytes:
        name = node_name(user.topic)
        number = self._next_request() % REQUEST_IDS
        # by naming CallFailure a caller asks to be told why there is no answer
        metadata = Metadata(
            request_id=number,
            message_manager=CallFailure.manager,
            node_type=NodeType.CLIENT,
            node_name=name,
            data_exchange_type=user.type,
        )
        answer = self._open[robot, name, number] = asyncio.get_running_loop().create_future()
        try:
            self.agent.send(request, to=ROS, ids=[robot], metadata=metadata)
            await asyncio.wait([answer], timeout=max(0.001, until.left_s))
            if not answer.done():
                raise CallTimeout(f"service {user.topic} of ros/{robot}", until.timeout_s)
            response: bytes = answer.result()
            return response
        finally:
            del self._open[robot, name, number]
            answer.cancel()

    async def _node(
        self,
        kind: NodeType,
        topic: str,
        of_type: str | None,
        robots: Collection[int],
        groups: Collection[int],
        until: Deadline,
    ) -> Node:
        """The node of a topic or service, as it is, or a new one."""
        known = self._nodes.get((kind, node_name(topic)))
        if of_type is None:
            of_type = (
                known.wanted.data_exchange_type if known else await self._type(kind, topic, robots, groups, until)
            )
        known = self._nodes.get((kind, node_name(topic)))
        of_type = short_type(of_type)
        if known is None:
            me = self.agent.key
            return Node(AddNode(*me, int(kind), node_name(topic), topic, of_type, buffer_size=0))
        if (known.topic, known.wanted.data_exchange_type) != (topic, of_type):
            other = f"{known.topic} with type {known.wanted.data_exchange_type}"
            raise UsageError(f"{topic} ({of_type}) has the same interface node as {other}, which this agent uses")
        return known

    async def _type(
        self, kind: NodeType, topic: str, robots: Collection[int], groups: Collection[int], until: Deadline
    ) -> str:
        """What the robots that are meant, and are online, call the type."""

        async def offers(robot: int) -> Functionality:
            answer = await self.agent.call(ROS, robot, "offers", timeout_s=max(0.001, until.left_s))
            return decode_data(Functionality, answer, ANSWER_BYTES)

        asked = self._online(robots, groups)
        if not asked:
            raise Unreachable(f"the robots of {topic}", "none is online to tell its type; say it, as pkg/Name")
        answers = await asyncio.gather(*map(offers, asked), return_exceptions=True)
        told = [answer for answer in answers if isinstance(answer, Functionality)]
        for answer in answers:
            if not told and isinstance(answer, BaseException):
                raise answer
        return type_behind(topic, kind, told)

    def means(self, user: NodeUser, robot: int) -> bool:
        """Whether a robot is one of those that a user named, by its id or its group."""
        if robot in user.robots:
            return True
        found = self.agent.directory.get(ROS, robot) if user.groups else None
        return found is not None and found.group in user.groups

    def _online(self, robots: Collection[int], groups: Collection[int]) -> list[int]:
        return [robot.id for robot in self.agent.directory.of_type(ROS) if robot.id in robots or robot.group in groups]

    async def _use(self, user: User, node: Node, until: Deadline, depth: int = DEPTH) -> User:
        """Register for this user what is not registered, and wait for the robots that are online.

        Raises Refused when all of them refuse, CallTimeout when none answers.
        """
        self._nodes[node.key] = node
        covered = {robot for robot in self._online(user.robots, user.groups) if robot in node.confirmed}
        is_new = not (user.robots <= node.robots and user.groups <= node.groups)
        node.users.append(user)
        if is_new or node.wanted.buffer_size < depth or covered != set(self._online(user.robots, user.groups)):
            node.wanted = structs.replace(node.wanted, buffer_size=max(node.wanted.buffer_size, depth))
            node.refused.clear()
            node.confirmed.clear()  # all of them are asked again
            self._calls.register(node.wanted, sorted(user.robots), sorted(user.groups))
        try:
            await self._answered(user, node, until)
        except BaseException:
            user.close()
            raise
        return user

    async def _answered(self, user: NodeUser, node: Node, until: Deadline) -> None:
        while user.is_open:
            meant = self._online(user.robots, user.groups)
            waiting = [robot for robot in meant if robot not in node.confirmed and robot not in node.refused]
            if 0 in node.refused:
                raise Refused(node.refused[0])
            left_s = until.left_s
            if waiting and left_s > 0:
                node.changed.clear()
                with suppress(asyncio.TimeoutError):
                    await within(node.changed.wait(), left_s)
                continue
            if any(robot in node.confirmed for robot in meant):
                return
            if waiting:
                raise CallTimeout(f"registration of {node.topic} on ros/{waiting[0]}", until.timeout_s)
            if meant:
                raise Refused(_reasons({robot: node.refused[robot] for robot in meant}))
            log.info("%s: no robot that was named is online; registered when one comes", node.topic)
            return
        raise Closed(f"the node of {node.topic}")

    def leave(self, node: Node, user: NodeUser) -> None:
        """A user has closed."""
        node.users.remove(user)
        if not node.users:
            if self._nodes.get(node.key) is node:
                del self._nodes[node.key]
            node.let_go()
        gone = sorted(user.robots - node.robots), sorted(user.groups - node.groups)
        if not self._closed and any(gone):
            self._calls.register(RemoveNode(*self.agent.key, *node.key), *gone)
            if node.robots or node.groups:
                node.confirmed.intersection_update(self._online(node.robots, node.groups))

    # -- what robots say -----------------------------------------------------------------------------------------

    def _streams_changed(self, changes: StreamChanges) -> None:
        """Listen to exactly those topics of robots that are used."""
        for (robot, name), registrants in changes:
            if registrants is None:
                if (stream := self._streams.pop((robot, name), None)) is not None:
                    stream.close()
                if (node := self._nodes.get((NodeType.SUBSCRIBER, name))) is not None:
                    node.let_go(robot)
            elif (robot, name) not in self._streams:
                key = STREAM.of(type=ROS, id=robot, node=name)
                take = partial(self._take_data, robot, name)
                self._streams[robot, name] = self.agent.mesh.subscribe(key, take, reliable=True, patient=self._patient)

    def _take_data(self, robot: int, name: str, batch: Iterator[Sample]) -> None:
        for key, payload in batch:
            node = self._nodes.get((NodeType.SUBSCRIBER, name))
            data = self._reader.read(key, name, payload, self.agent.key)
            if node is None or not data:
                continue
            of_type, now = node.wanted.data_exchange_type, self.agent.mesh.came_s
            messages = [TopicMessage(robot, node.topic, of_type, cdr, self.types, now) for cdr in data]
            self._late.hold(node, robot, messages)
            for user in list(node.users):
                if self.means(user, robot):
                    self._give(user, messages)

    def _give(self, user: NodeUser, messages: Iterable[TopicMessage]) -> None:
        assert isinstance(user, TopicSubscription)
        for message in messages:
            if not user.put(message):
                self.agent.drops.note(
                    "topic_full", user.topic, f"taken too slowly, the oldest of {user.depth} is dropped"
                )

    def _bad_frame(self, key: str, error: WireError) -> None:
        self.agent.drops.once("bad_frame", "a frame on %s cannot be used: %s", key, error)

    def take(self, message: Message) -> bool:
        """A message to this agent: whether it was an answer to what is used here."""
        said = message.metadata
        if said.sender_agent_type != ROS:
            return False
        if said.message_manager == DataRefused.manager:
            return self._data_refused(message)
        answer = self._open.get((message.sender_id, said.node_name, said.request_id))
        if said.node_type != NodeType.CLIENT or answer is None or answer.done():
            return False
        # a robot that knows no failures may copy the manager of the request; CDR never begins with a brace
        if said.message_manager == CallFailure.manager and message.data[:1] == b"{":
            answer.set_exception(_failure(message))
        else:
            answer.set_result(message.data)
        return True

    def _data_refused(self, message: Message) -> bool:
        try:
            refusal = decode_data(DataRefused, message.data)
        except WireError as error:
            self._bad_frame(f"a message of ros/{message.sender_id}", error)
            return True
        node = self._nodes.get((refusal.node_type, refusal.node_name))
        if node is None:
            return False
        robot, reason = message.sender_id, refusal.reason
        told = (node.key, robot, reason)
        if told not in self._logged and len(self._logged) < KNOWN:
            self._logged.add(told)
            log.warning("ros/%d does not take part in %s: %s (logged once)", robot, node.topic, reason)
        self._tell_refused(node, robot, reason)
        return True

    def _node_refused(self, _: AgentKey, refused: NodeRefused) -> None:
        node = self._nodes.get((refused.node_type, refused.node_name))
        if node is not None:
            node.confirmed.discard(refused.robot_id)
            node.refused[refused.robot_id] = refused.reason
            node.changed.set()
            self._tell_refused(node, refused.robot_id, refused.reason)

    def _tell_refused(self, node: Node, robot: int, reason: str) -> None:
        for user in list(node.users):
            if robot == 0 or self.means(user, robot):
                user.told_refused(robot, reason)

    def _confirmed(self, task: Task) -> None:
        node = self._nodes.get((task.node.node_type, task.node.node_name))
        if node is not None and isinstance(task.node, AddNode):
            node.confirmed.add(task.robot_id)
            node.refused.pop(task.robot_id, None)
            node.changed.set()

    # -- the mesh ------------------------------------------------------------------------------------------------

    def presence(self, change: Change) -> None:
        """Somebody came or left: robots that come back are told again what is used of them."""
        if change.agent.type == ROS:
            self._late.is_back(change.agent.id)
            for node in self._nodes.values():
                node.confirmed.discard(change.agent.id)
                node.refused.pop(change.agent.id, None)
                node.let_go(change.agent.id)  # it gives anew what it holds
                node.changed.set()
            if not change.online:
                for (robot, _, _), answer in self._open.items():
                    if robot == change.agent.id and not answer.done():
                        answer.set_exception(Unreachable(f"ros/{robot}", "it has left"))
        self._calls.presence(change)

    def id_changed(self, old: AgentKey, new: int) -> None:
        """This agent has another id now: what was registered is registered under that."""
        for node in self._nodes.values():
            node.confirmed.clear()
            node.wanted = structs.replace(node.wanted, registrant_agent_id=new)
        task = asyncio.get_running_loop().create_task(self._calls.rename(old, new, [], set()))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def close(self) -> None:
        """The agent leaves: robots see that by its presence."""
        self._closed = True
        self._following.close()
        for task in [*self._tasks, *self._registering.values()]:
            task.cancel()
        self._calls.close()
        for node in list(self._nodes.values()):
            for user in list(node.users):
                user.close()
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
        for answer in self._open.values():
            if not answer.done():
                answer.set_exception(Closed(str(self.agent.key)))


def _reasons(refused: Mapping[int, str]) -> str:
    """What robots said; where it is one, no more than that."""
    if len(set(refused.values())) == 1:
        return next(iter(refused.values()))
    return "; ".join(f"ros/{robot}: {reason}" for robot, reason in sorted(refused.items()))


def _failure(message: Message) -> MacsError:
    try:
        failure = decode_data(CallFailure, message.data)
    except WireError as error:
        return error
    if failure.kind in ("absent", "timeout"):
        return Unreachable(f"service {message.metadata.node_name} of ros/{message.sender_id}", failure.reason)
    return Refused(failure.reason)
