"""The interface nodes of a robot: what headsets have registered, by node type and topic.

`InterfaceNodes` belongs to the event loop; what is on the ROS graph is made and destroyed in the ROS thread. Commands
come in Zenoh's threads (`macs_zenoh.protocol.guard`), so that nothing that the loop is busy with can hold them up, nor
a stop. One table of nodes, and what waits for them, under one lock: so one module.
"""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TypeVar

from bridge.ros.actions import ActionNode, tell_no_goal
from bridge.ros.early import ASKING, EarlyMessages, NodeKey
from bridge.ros.failures import tell_failure
from bridge.ros.interface import InterfaceNode, Registrant, Robot, full_name, key_of
from bridge.ros.places import Places
from bridge.ros.rights import Rights
from bridge.ros.served import ServiceNode
from bridge.ros.services import ClientNode
from bridge.ros.side import NamesAndTypes, first_line
from bridge.ros.stop import StopNode
from bridge.ros.subscriber import SubscriberNode
from bridge.ros.topics import PublisherNode, types_of_others
from bridge.ros.types import InterfaceName
from macs_zenoh.deadline import Deadline
from macs_zenoh.errors import MacsError, Refused
from macs_zenoh.protocol.budget import may_have_one_more
from macs_zenoh.protocol.guard import says_halt
from macs_zenoh.protocol.messages import (
    OTHER_TYPE,
    ROS,
    ActionVerb,
    AddNode,
    DataRefused,
    Metadata,
    NodeType,
    RemoveNode,
    encode_data,
    node_name,
)
from macs_zenoh.protocol.reading import Message

log = logging.getLogger("macs.ros")

KINDS: dict[int, type[InterfaceNode]] = {
    kind.NODE_TYPE: kind for kind in (SubscriberNode, PublisherNode, ClientNode, ServiceNode, ActionNode)
}
"""Interface nodes by their number on the wire."""


MOVING = (NodeType.PUBLISHER, NodeType.ACTION)
"""Nodes for which messages may move the robot on and on."""

GONE_S = 2.0
"""After so long nothing of a removed node is left in ROS."""
LOOK_S = 0.05

T = TypeVar("T")

Work = tuple[int, str]
"""What a node is the only one for: its type, and the full name of its topic, service or action. Topics of the robot
(type 1) are kept by node name, which is part of the key of their stream."""

MIN_SHARE = 16
"""What one agent may have on a robot that has few interface nodes; otherwise half of them, and less when most are in
use (`may_have_one_more`)."""


class InterfaceNodes:
    """All interface nodes of a robot, by node type and topic."""

    def __init__(self, robot: Robot, max_nodes: int = 256) -> None:
        self.drops = robot.drops
        self.robot = robot
        self._max_nodes = max_nodes
        self.rights = Rights(robot.rules.settings, lambda agent: robot.group_of(agent))
        self._nodes: dict[Work, InterfaceNode] = {}
        self._places: Places[InterfaceNode] = Places()
        self._loop = asyncio.get_running_loop()
        self._left: dict[tuple[NodeKey, Registrant], float] = {}
        """When somebody left a node, a moment ago."""
        self._removed: dict[str, float] = {}
        """When a node on this topic was removed last."""
        self._early = EarlyMessages()
        self._early_lock = threading.RLock()
        """Held while it is settled whether a message waits for its node, and while a node takes those that did."""
        self._expiring = False
        self._expiry = Deadline(self._expire)
        self._lingering: dict[tuple[NodeKey, Registrant], asyncio.TimerHandle] = {}

        self.stop: StopNode | None = None

    def __iter__(self) -> Iterator[InterfaceNode]:
        return iter(list(self._nodes.values()))

    def __len__(self) -> int:
        """How many are registered; the emergency stop is always there."""
        return sum(node is not self.stop for node in self)

    def get(self, node_type: int, node_name: str) -> InterfaceNode | None:
        """The first interface node of this name, None when nobody registered one."""
        return self._places.first(NodeKey(node_type, node_name))

    def on_topic(self, node_type: int, topic: str) -> InterfaceNode | None:
        """The interface node that works on a topic, service or action, by its full name."""
        return self._nodes.get((node_type, topic))

    async def add(self, request: AddNode) -> None:
        """Register an agent on an interface node, which the first registration creates.

        A repeated registration changes nothing; a further registrant takes the node as it is.
        Raises Refused: node type not supported, invalid name, node name not that of the topic, type not installed,
        type of the topic is another one, name taken by another topic, limit reached, not allowed to this agent.
        """
        registrant = Registrant(request.registrant_agent_type, request.registrant_agent_id)
        if request.node_type != NodeType.SUBSCRIBER:
            self.rights.check(registrant)
        key = key_of(request)
        self._take_back_other(key, registrant, request)
        await self._make_room(request)
        node = self._find_or_create(request, self._places.of(key, registrant))
        is_new = registrant not in node.registrants
        node.register(registrant, unity=request.unity_cdr is True)
        self._places.bind(key, node, registrant)
        if is_new and node.is_open:
            node.welcome(registrant)
        self._end_lingering(node, registrant)
        assert node.opening is not None
        await asyncio.shield(node.opening)
        if node.is_open:
            self._pass_early(node, key)

    def _take_back_other(self, key: NodeKey, registrant: Registrant, request: AddNode) -> None:
        """Who registers a node with another type does not want the one before, whatever became of its removal."""
        node = self._places.of(key, registrant)
        kind = KINDS.get(request.node_type)
        if node is None or kind is None or node is self.stop or registrant not in node.registrants:
            return
        same_topic = node.topic == full_name(self.robot, kind, request.tos_name)
        if same_topic and node.interface != InterfaceName.parse(request.data_exchange_type, kind.INTERFACE):
            self.remove(RemoveNode(*registrant, key.node_type, key.node_name))

    async def _make_room(self, request: AddNode) -> None:
        """A node whose type nobody else on the robot uses gives way to one of the type that they use."""
        for node in self._places.all_of(key_of(request)):
            if node is self.stop or node.request.data_exchange_type == request.data_exchange_type or not node.is_open:
                continue
            others = await self.robot.session.run(node.other_types)
            kind = KINDS[request.node_type]
            if str(InterfaceName.parse(request.data_exchange_type, kind.INTERFACE)) in others and node in self:
                self._tell_type(node, others)
                self._remove(node)

    def look_at_types(self, topics: NamesAndTypes, services: NamesAndTypes) -> None:
        """The graph has changed: registrants of what has another type now get nothing, so they are told. In the ROS
        thread."""
        known = {**dict(topics), **dict(services)}
        for node in self:
            types = known.get(node.topic, ())
            others = node.other_types() if set(types) - {str(node.interface)} else set()
            if others != node.told_types:
                node.told_types = others
                if others:
                    self._loop.call_soon_threadsafe(self._tell_type, node, others)

    def _tell_type(self, node: InterfaceNode, types: set[str]) -> None:
        reason = f"{node.topic} has type {' and '.join(sorted(types))} on this robot now, not {node.interface}"
        self.drops.note("other_type", node.topic, reason)
        for registrant in node.registrants:
            told = DataRefused(
                robot_id=self.robot.agent_id,
                node_type=node.key.node_type,
                node_name=node.key.node_name,
                tos_name=node.topic,
                kind=OTHER_TYPE,
                reason=reason,
            )
            metadata = Metadata(ROS, self.robot.agent_id, message_manager=told.manager)
            self.robot.send(registrant, metadata, encode_data(told))

    def _find_or_create(self, request: AddNode, meant: InterfaceNode | None) -> InterfaceNode:
        """``meant``: what its registrant has by this node name; more than that its messages do not say."""
        kind = KINDS.get(request.node_type)
        if kind is None:
            raise Refused(f"interface node type {request.node_type} is unknown on this robot")
        topic = full_name(self.robot, kind, request.tos_name)
        if request.node_name != node_name(request.tos_name):
            problem = f"not a valid node name for {request.tos_name[:80]}, which is {node_name(request.tos_name)[:80]}"
            raise Refused(f"{request.node_name[:80]!r} is {problem}")
        if meant is not None and meant.topic != topic:  # before a node is made that nobody would ever remove
            raise meant.collision(topic, request.node_name)
        by_name = request.node_type == NodeType.SUBSCRIBER
        node = self._nodes.get((request.node_type, request.node_name if by_name else topic))
        if self.stop is not None and node is not self.stop and key_of(request) == self.stop.key:
            raise self.stop.collision(topic, request.node_name)  # whoever sends there wants to stop the robot
        if node is None:
            return self._create(kind, request)
        node.check_same(request)
        return node

    async def open_stop(self, topic: str) -> None:
        """Have an emergency stop on this topic. Raises Refused when the topic cannot be used for it."""
        self.robot.rules.stop_names.add(full_name(self.robot, StopNode, topic))  # remapped, or in a namespace
        stop = StopNode(self.robot, topic, self._stopped)
        for node in self._places.all_of(stop.key):  # of headsets that registered what has its name meanwhile
            self._remove(node)
        await self._make_room_for_stop(stop)
        self._nodes[_work(stop)] = stop
        self._places.bind(stop.key, stop)
        await self._start(stop)
        self.stop = stop

    async def _make_room_for_stop(self, stop: StopNode) -> None:
        """A topic that headsets take, or took, with another type may be only theirs by now: then they lose it, or
        there would be no emergency stop as long as they like."""
        side, topic = self.robot.session, stop.topic

        def types() -> set[str]:
            return types_of_others(side, [*side.publishers(topic), *side.subscriptions(topic)])

        if await self.robot.session.run(types) - {str(stop.interface)}:
            return
        for other in self:
            if other.INTERFACE == stop.INTERFACE and other.topic == topic and other.interface != stop.interface:
                self._tell_type(other, {str(stop.interface)})
                self._remove(other)

    def _stopped(self, by: str) -> None:
        # what moves the robot now comes first
        self._each(lambda node: node.emergency_stop(by), sorted(self, key=_has_no_stop_message))

    def _each(self, do: Callable[[InterfaceNode], None], nodes: Iterable[InterfaceNode] | None = None) -> None:
        """One node that fails keeps no other from being stopped, left or removed."""
        for node in self if nodes is None else nodes:
            try:
                do(node)
            except Exception:
                log.exception("%s: a %s failed", node.topic, node.ROLE)

    def remove(self, request: RemoveNode) -> None:
        """Take a registrant off a node; the last one removes it. Asking for what is not there changes nothing."""
        registrant, key = Registrant(request.registrant_agent_type, request.registrant_agent_id), key_of(request)
        node = self._places.of(key, registrant)
        if node is not None:
            self._places.unbind(node, registrant, key)
            if not any(self._places.names_of(node, registrant)):
                self._deregister(node, registrant)

    def forget(self, registrant: Registrant, *, for_good: bool = False) -> None:
        """Take an agent that left off every node. Its commands count as stopped, registered or not. ``for_good``: it
        will not come back, its id is another one's."""
        with self._early_lock:
            self._early.drop(registrant)
        self._each(lambda node: node.left(registrant))

        def let_go(node: InterfaceNode) -> None:
            if node.linger_s and not for_good:
                self._linger(node, registrant)
            else:
                self._deregister(node, registrant)

        self._each(let_go, [node for node in self if registrant in node.registrants])

    def fell_asleep(self, registrant: Registrant) -> None:
        """The connection of an agent has ended, and it may come back as the same one. What it moves stops, and what it
        sent to move something is not done later; all else stays."""
        with self._early_lock:
            self._early.drop(registrant, MOVING)
        self._each(lambda node: node.fell_asleep(registrant))

    def stays_asleep(self, registrant: Registrant) -> None:
        """It is still not back: nobody waits for it any more."""
        self._each(lambda node: node.stays_asleep(registrant))

    def arrived(self, registrant: Registrant) -> None:
        """An agent is seen now; what it sent before waits to be judged."""
        self.rights.changed()
        with self._early_lock:
            for key in self._early.keys(registrant):
                self._pass_waiting(registrant, key)

    def returned(self, registrant: Registrant) -> None:
        """An agent that seemed to have left is there again, the same one."""
        self._each(lambda node: node.returned(registrant))

    def cut_off(self) -> None:
        """The robot has lost the mesh: all who commanded count as gone."""
        self._each(lambda node: node.cut_off())

    def forget_all(self) -> None:
        """Remove all that anybody registered; only the emergency stop stays."""
        self._each(self._remove, [node for node in self if node is not self.stop])

    def deliver(self, message: Message) -> None:
        """Pass a message that names an interface node to it. Never raises for what a peer sent. On the loop; commands
        (type 2) from any thread.

        A registration is a call of its own, which the first message can overtake: a few wait for a moment.
        """
        key, sender = NodeKey(message.metadata.node_type, message.metadata.node_name), Registrant.of(message)
        if self.stop is not None and key == self.stop.key:
            self.stop.receive(message)  # who may is its own matter
            return
        if not self._early.waits(sender) and self._deliver(key, message):
            return
        with self._early_lock:
            self._pass_waiting(sender, key)
            if self._early.first(sender, key) is not None or not self._deliver(key, message):
                self._keep_early(key, message)

    def _deliver(self, key: NodeKey, message: Message) -> bool:
        """Whether a message need not wait."""
        node = self._meant(key, message)
        if not self.rights.may_act(message.sender_type, message.sender_id):
            if not self.robot.is_online(Registrant.of(message)):
                return False  # not seen yet
            self._refuse(node, key, message)
            return True
        if node is None or not node.is_open:
            return False
        node.receive(message)
        return True

    def _pass_waiting(self, sender: Registrant, key: NodeKey) -> None:
        """Deliver what waits of one sender for one node, as far as it need not any more: where the oldest has to, so
        have all. With the lock, and until all is delivered it counts as waiting: nothing newer overtakes it in another
        thread."""
        while (message := self._early.first(sender, key)) is not None:
            passed = True
            try:
                aged = self._aged(key, message)
                passed = aged is None or self._deliver(key, aged)
            finally:
                if passed:
                    self._early.remove(key, message)
            if not passed:
                return

    def _keep_early(self, key: NodeKey, message: Message) -> None:
        if self._has_just_left(key, message):
            self.drops["after_leaving"] += 1
            self._tell_unanswered(message, "its sender took this node back")
            return
        for lost in self._early.hold(key, message, time.monotonic()):
            reason = "more data before the registration than can be kept"
            about = f"{key.node_name[:80]}: {reason}"  # once for each sender, who may make up names
            self.drops.note("held_full", str(Registrant.of(message)), about)
            self._tell_unanswered(lost, reason)
        if not self._expiring:
            self._expiring = True
            self._loop.call_soon_threadsafe(self._schedule_expiry)

    def _meant(self, key: NodeKey, message: Message) -> InterfaceNode | None:
        """The node that a message is for; None as well while it depends on a registration that may be under way."""
        return self._places.sole(key) or self._places.of(key, Registrant.of(message))

    def _refuse(self, node: InterfaceNode | None, key: NodeKey, message: Message) -> None:
        """What somebody sent who may not act here, registered or not."""
        reason = f"{Registrant.of(message)} may not command, call or serve on this robot"
        about = node.topic if node is not None else key.node_name[:80]
        self.drops.note("not_allowed", f"{about} from {Registrant.of(message)}", reason)
        if node is not None:
            node.refused(message, reason)
        else:
            tell_failure(self.robot, message, "refused", reason)

    def _pass_early(self, node: InterfaceNode, key: NodeKey) -> None:
        """Give a node what came before the registration that it belongs to."""
        with self._early_lock:
            for message in self._early.waiting_for(key):
                may_act = isinstance(node, StopNode) or self.rights.may_act(message.sender_type, message.sender_id)
                if may_act and self._meant(key, message) is node:
                    aged = self._aged(key, message)
                    try:
                        if aged is not None:
                            node.receive(aged)
                    finally:
                        self._early.remove(key, message)

    def _aged(self, key: NodeKey, message: Message) -> Message | None:
        """A message as old as it has become while it waited here; None for a command that is too old by now, and for
        what would act on a robot that was stopped meanwhile."""
        waited_s = self._early.waited_s(key, message, time.monotonic())
        if self._was_stopped(waited_s) and self._acts(key, message):
            reason = "the robot was stopped while this waited for its registration"
            self.drops.note("stopped", f"{key.node_name[:80]} from {Registrant.of(message)}", reason)
            self._tell_unanswered(message, reason)
            return None
        if key.node_type != NodeType.PUBLISHER:
            return message
        age_s = message.age_s + waited_s
        settings = self.robot.rules.settings
        late = 0 < settings.max_command_age_s < age_s
        if message.metadata.clock:
            late |= 0 < settings.max_timed_command_age_s < message.at_most_s + waited_s
        stops = (self.stop is not None and key == self.stop.key) or says_halt(message)
        if late and not stops:
            reason = f"a command waited for {age_s:.2f} s or more, the last of it for its registration"
            self.drops.note("too_old", f"{key.node_name[:80]} from {Registrant.of(message)}", reason)
            return None
        return message._replace(age_s=age_s, at_most_s=message.at_most_s + waited_s)

    def _was_stopped(self, within_s: float) -> bool:
        """Whether a stop has ended since then; one that holds is for the nodes to judge."""
        stop = self.robot.stop
        return stop.times > 0 and not stop.stopped and time.time() - stop.since < within_s

    def _acts(self, key: NodeKey, message: Message) -> bool:
        node = self._meant(key, message)
        if node is None or node is self.stop or node.rule.allow_while_stopped:
            return False
        if key.node_type == NodeType.ACTION:
            return message.metadata.message_manager == ActionVerb.GOAL
        return key.node_type in (NodeType.PUBLISHER, NodeType.CLIENT)

    def last_words(self) -> None:
        """This program is about to end without closing anything: no last command may stay. From any thread."""
        self._each(lambda node: node.retire(), [node for node in self if isinstance(node, PublisherNode)])

    def close(self) -> None:
        """Remove all nodes."""
        self._each(self._remove)
        self._expiry.cancel()
        self.robot.alarms.close()

    def _create(self, kind: type[InterfaceNode], request: AddNode) -> InterfaceNode:
        if len(self) >= self._max_nodes:
            raise Refused(f"this robot has {self._max_nodes} interface nodes, which is its limit")
        registrant = Registrant(request.registrant_agent_type, request.registrant_agent_id)
        mine = sum(registrant in node.registrants for node in self)
        if not may_have_one_more(len(self), mine, each=max(MIN_SHARE, self._max_nodes // 2), total=self._max_nodes):
            raise Refused(f"{registrant} has {mine} interface nodes on this robot; the rest is for others")
        node = kind(self.robot, request)
        self._nodes[_work(node)] = node
        self._places.bind(node.key, node)
        node.unused = lambda: self._remove(node) if self._nodes.get(_work(node)) is node else None
        self._start(node)
        return node

    def _start(self, node: InterfaceNode) -> asyncio.Task[None]:
        # now, so that it comes before `close`, whenever that comes
        opened = self.robot.session.submit(lambda: self._open_entity(node))
        node.opening = asyncio.get_running_loop().create_task(self._open(node, asyncio.wrap_future(opened)))
        node.opening.add_done_callback(_retrieve)
        return node.opening

    def _open_entity(self, node: InterfaceNode) -> None:
        """In the ROS thread."""
        try:
            node.open()
        except MacsError:
            raise
        except Exception as error:
            log.exception("%s: %s %s cannot be made", node.topic, node.ROLE, node.interface)
            problem = f"{type(error).__name__}: {first_line(error)}"
            raise Refused(
                f"{node.topic} with type {node.interface} cannot be used on this robot: {problem}"
            ) from error
        known = [rule.match for rule in self.robot.rules.settings.rules] + node.known_names()
        node.alike = any(node_name(other) == node.key.node_name and other != node.topic for other in known)

    async def _open(self, node: InterfaceNode, opened: asyncio.Future[None]) -> None:
        try:
            await self._until_open(node, opened)
            await node.settle()
        except BaseException:
            if self._nodes.get(_work(node)) is node:
                del self._nodes[_work(node)]
                self._places.remove(node)
            raise
        if self._nodes.get(_work(node)) is not node:  # its registrants left meanwhile
            return
        log.info("%s: %s %s", node.topic, node.ROLE, node.interface)
        try:
            with self._early_lock:
                try:
                    self._places.look(node)
                    self._pass_early(node, node.key)
                finally:
                    node.is_open = True  # not sooner: no message may overtake these
        finally:
            for registrant in node.registrants:
                node.welcome(registrant)

    async def _until_open(self, node: InterfaceNode, opened: asyncio.Future[None]) -> None:
        """ROS shows what we closed for a moment, and our last messages keep it for another: no reason to refuse what
        comes in its place."""
        while True:
            try:
                return await opened
            except Refused:
                since_s = self._loop.time() - self._removed.get(node.topic, -math.inf)
                if since_s > GONE_S or self._nodes.get(_work(node)) is not node:
                    raise
            await asyncio.sleep(LOOK_S)
            if self._nodes.get(_work(node)) is not node:
                return None
            opened = asyncio.wrap_future(self.robot.session.submit(partial(self._open_entity, node)))

    def _note_removed(self, topic: str) -> None:
        _note(self._removed, topic, self._loop.time())

    def _linger(self, node: InterfaceNode, registrant: Registrant) -> None:
        """Its gateway may only have lost the way to us: what it will ask for then has to be there."""
        self._end_lingering(node, registrant)
        self._lingering[node.key, registrant] = asyncio.get_running_loop().call_later(
            node.linger_s, self._deregister, node, registrant
        )

    def _end_lingering(self, node: InterfaceNode, registrant: Registrant) -> None:
        if (lingering := self._lingering.pop((node.key, registrant), None)) is not None:
            lingering.cancel()

    def _note_left(self, node: InterfaceNode, registrant: Registrant) -> None:
        for key in {node.key, *self._places.names_of(node, registrant)}:
            _note(self._left, (key, registrant), self._loop.time())

    def _has_just_left(self, key: NodeKey, message: Message) -> bool:
        """Whether the sender has taken a node back that its message was for: a removal is a call, and overtakes."""
        return self._left.get((key, Registrant.of(message)), -math.inf) > self._loop.time() - GONE_S

    def _deregister(self, node: InterfaceNode, registrant: Registrant) -> None:
        self._note_left(node, registrant)
        self._end_lingering(node, registrant)
        node.deregister(registrant)
        self._places.unbind(node, registrant)
        if not node.in_use:
            self._remove(node)

    def _remove(self, node: InterfaceNode) -> None:
        for registrant in node.registrants:
            self._end_lingering(node, registrant)
        del self._nodes[_work(node)]
        self._places.remove(node)
        node.is_open = False
        self._note_removed(node.topic)
        self._each(lambda node: node.retire(), [node])
        self.robot.session.submit(node.close)
        log.info("%s: %s removed", node.topic, node.ROLE)

    def _schedule_expiry(self) -> None:
        with self._early_lock:
            deadline = self._early.next_deadline()
            self._expiring = deadline is not None
        if not self._expiry.is_set:
            self._expiry.set(deadline)

    def _expire(self) -> None:
        now = time.monotonic()
        with self._early_lock:
            expired = self._early.expire(now)
        for key, messages in expired.items():
            if key.node_type in ASKING and self._is_opening(key):
                with self._early_lock:
                    for message in messages:  # its node comes late, but it comes; its sender knows how long to wait
                        self._early.hold(key, message, now)
                continue
            for message in [m for m in messages if not self.rights.may_act(m.sender_type, m.sender_id)]:
                messages.remove(message)
                self._refuse(self._meant(key, message), key, message)
            if not messages:
                continue
            reason = f"nobody registered this node with type {key.node_type}"
            if self._places.first(key) is not None:
                reason = f"several topics have this node name, and the sender registered none of type {key.node_type}"
            self.drops.note("no_node", key.node_name[:80], reason, len(messages))
            for message in messages:
                self._tell_unanswered(message, reason)
        self._schedule_expiry()

    def _is_opening(self, key: NodeKey) -> bool:
        """Whether there will be a node of this name, most likely."""
        node = self._places.first(key)
        return node is not None and node.opening is not None and not node.opening.done()

    def _tell_unanswered(self, message: Message, reason: str) -> None:
        """What nobody will answer: tell who waits for it."""
        tell_failure(self.robot, message, "refused", reason)
        tell_no_goal(self.robot, message, reason)


def _note(table: dict[T, float], what: T, now: float) -> None:
    """Note when something was, in a table that has them in their order, and forget what has gone by now: few of them
    each time, however many there are."""
    table.pop(what, None)
    table[what] = now
    while table[first := next(iter(table))] <= now - GONE_S:
        del table[first]


def _work(node: InterfaceNode) -> Work:
    return node.key if node.NODE_TYPE == NodeType.SUBSCRIBER else (node.NODE_TYPE, node.topic)


def _has_no_stop_message(node: InterfaceNode) -> bool:
    return not (isinstance(node, PublisherNode) and node.deadman is not None)


def _retrieve(task: asyncio.Task[None]) -> None:
    """Look at the task's error, so that asyncio does not warn when every waiter was cancelled."""
    if not task.cancelled():
        task.exception()
