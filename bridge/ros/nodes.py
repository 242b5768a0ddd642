"""The interface nodes of a robot: what headsets have registered, by node type and node name.

`InterfaceNodes` belongs to the event loop; rclpy's entities are made and destroyed in the ROS thread.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator

from bridge.ros.actions import ActionNode
from bridge.ros.early import EarlyMessages, NodeKey
from bridge.ros.interface import InterfaceNode, Registrant, Robot, key_of
from bridge.ros.rules import names_agent
from bridge.ros.services import ClientNode, ServiceNode, tell_failure
from bridge.ros.stop import StopNode
from bridge.ros.topics import PublisherNode, SubscriberNode
from macs_zenoh.errors import Refused
from macs_zenoh.keyexpr import type_name
from macs_zenoh.messages import AddNode, NodeType, RemoveNode
from macs_zenoh.reading import Message

log = logging.getLogger("macs.ros")

KINDS: dict[int, type[InterfaceNode]] = {
    kind.NODE_TYPE: kind for kind in (SubscriberNode, PublisherNode, ClientNode, ServiceNode, ActionNode)
}
"""Interface nodes by their number on the wire."""


class InterfaceNodes:
    """All interface nodes of a robot, by node type and node name."""

    def __init__(self, robot: Robot, max_nodes: int = 256) -> None:
        self.drops = robot.drops
        self.robot = robot
        self._max_nodes = max_nodes
        self._nodes: dict[NodeKey, InterfaceNode] = {}
        self._early = EarlyMessages()
        self._expiry: asyncio.TimerHandle | None = None
        self._lingering: dict[tuple[NodeKey, Registrant], asyncio.TimerHandle] = {}

        self.stop: StopNode | None = None

    def __iter__(self) -> Iterator[InterfaceNode]:
        return iter(list(self._nodes.values()))

    def __len__(self) -> int:
        """How many are registered; the emergency stop is always there."""
        return len(self._nodes) - (self.stop is not None)

    def get(self, node_type: int, node_name: str) -> InterfaceNode | None:
        """An interface node, None when nobody registered it."""
        return self._nodes.get(NodeKey(node_type, node_name))

    async def add(self, request: AddNode) -> None:
        """Register an agent on an interface node, which the first registration creates.

        A repeated registration changes nothing; a further registrant takes the node as it is.
        Raises Refused: node type not supported, invalid name, type not installed, type of the topic is another one,
        name taken by another topic, limit reached, not allowed to this agent.
        """
        registrant = Registrant(request.registrant_agent_type, request.registrant_agent_id)
        if request.node_type != NodeType.SUBSCRIBER:
            self._check_allowed(registrant)
        node = self._nodes.get(key_of(request))
        if node is None:
            node = self._create(request)
        else:
            node.check_same(request)
        node.register(registrant)
        self._end_lingering(node, registrant)
        assert node.opening is not None
        await asyncio.shield(node.opening)

    async def open_stop(self, topic: str) -> None:
        """Have an emergency stop on this topic. Raises Refused when the topic cannot be used for it."""
        stop = StopNode(self.robot, topic, self._stopped)
        self._nodes[stop.key] = stop
        await self._start(stop)
        self.stop = stop

    def _stopped(self, by: str) -> None:
        for node in self:
            node.emergency_stop(by)

    def remove(self, request: RemoveNode) -> None:
        """Take a registrant off a node; the last one removes it. Asking for what is not there changes nothing."""
        node = self._nodes.get(key_of(request))
        if node is not None:
            self._deregister(node, Registrant(request.registrant_agent_type, request.registrant_agent_id))

    def forget(self, registrant: Registrant) -> None:
        """Take an agent that left off every node. Its commands count as stopped, registered or not."""
        for node in self:
            node.left(registrant)
            if registrant in node.registrants:
                if node.linger_s:
                    self._linger(node, registrant)
                else:
                    self._deregister(node, registrant)

    def forget_all(self) -> None:
        """Remove all that anybody registered; only the emergency stop stays."""
        for node in self:
            if node is not self.stop:
                self._remove(node)

    def deliver(self, message: Message) -> None:
        """Pass a message that names an interface node to it. Never raises for what a peer sent.

        A registration is a call of its own, which the first message can overtake: a few wait for a moment.
        """
        key = NodeKey(message.metadata.node_type, message.metadata.node_name)
        node = self._nodes.get(key)
        if node is not None and node.is_open:
            node.receive(message)
            return
        dropped = self._early.hold(key, message, asyncio.get_running_loop().time())
        if dropped:
            self.drops.note("held_full", key.node_name[:80], "more data before the registration than can be kept")
        self._schedule_expiry()

    def deliver_at_once(self, message: Message) -> bool:
        """The same in a thread of Zenoh's, for nodes that can; False: it is for `deliver`."""
        metadata = message.metadata
        node = self._nodes.get((metadata.node_type, metadata.node_name))  # type: ignore[call-overload]
        return node is not None and node.is_open and node.receive_at_once(message)

    def close(self) -> None:
        """Remove all nodes."""
        for node in self:
            self._remove(node)
        if self._expiry is not None:
            self._expiry.cancel()

    def _check_allowed(self, agent: Registrant) -> None:
        """What an agent may register for is in the payload, where no router's access rule can see it."""
        allowed = self.robot.rules.settings.register_allow
        if not names_agent(allowed, type_name(agent.agent_type), agent.agent_id, self.robot.group_of(agent)):
            raise Refused(f"{agent} may only register for topics that this robot sends")

    def _create(self, request: AddNode) -> InterfaceNode:
        kind = KINDS.get(request.node_type)
        if kind is None:
            raise Refused(f"interface node type {request.node_type} is unknown on this robot")
        if len(self) >= self._max_nodes:
            raise Refused(f"this robot has {self._max_nodes} interface nodes, which is its limit")
        node = kind(self.robot, request)
        self._nodes[node.key] = node
        node.unused = lambda: self._remove(node) if self._nodes.get(node.key) is node else None
        self._start(node)
        return node

    def _start(self, node: InterfaceNode) -> asyncio.Task[None]:
        opened = self.robot.session.submit(node.open)  # now, so that it comes before `close`, whenever that comes
        node.opening = asyncio.get_running_loop().create_task(self._open(node, asyncio.wrap_future(opened)))
        node.opening.add_done_callback(_retrieve)
        return node.opening

    async def _open(self, node: InterfaceNode, opened: asyncio.Future[None]) -> None:
        try:
            await opened
            await node.settle()
        except BaseException:
            if self._nodes.get(node.key) is node:
                del self._nodes[node.key]
            raise
        if self._nodes.get(node.key) is not node:  # its registrants left meanwhile
            return
        log.info("%s: %s %s", node.topic, node.ROLE, node.interface)
        try:
            for message in self._early.take(node.key):
                node.receive(message)
        finally:
            node.is_open = True  # not sooner: no message may overtake these

    def _linger(self, node: InterfaceNode, registrant: Registrant) -> None:
        """Its gateway may only have lost the way to us: what it will ask for then has to be there."""
        self._end_lingering(node, registrant)
        self._lingering[node.key, registrant] = asyncio.get_running_loop().call_later(
            node.linger_s, self._deregister, node, registrant
        )

    def _end_lingering(self, node: InterfaceNode, registrant: Registrant) -> None:
        if (lingering := self._lingering.pop((node.key, registrant), None)) is not None:
            lingering.cancel()

    def _deregister(self, node: InterfaceNode, registrant: Registrant) -> None:
        self._end_lingering(node, registrant)
        node.deregister(registrant)
        if not node.in_use:
            self._remove(node)

    def _remove(self, node: InterfaceNode) -> None:
        for registrant in node.registrants:
            self._end_lingering(node, registrant)
        del self._nodes[node.key]
        node.is_open = False
        node.retire()
        self.robot.session.submit(node.close)
        log.info("%s: %s removed", node.topic, node.ROLE)

    def _schedule_expiry(self) -> None:
        if self._expiry is None and (deadline := self._early.next_deadline()) is not None:
            self._expiry = asyncio.get_running_loop().call_at(deadline, self._expire)

    def _expire(self) -> None:
        self._expiry = None
        for key, messages in self._early.expire(asyncio.get_running_loop().time()).items():
            reason = f"nobody registered this node with type {key.node_type}"
            self.drops.note("no_node", key.node_name[:80], reason, len(messages))
            for message in messages:
                tell_failure(self.robot, message, "refused", reason)
        self._schedule_expiry()


def _retrieve(task: asyncio.Task[None]) -> None:
    """Look at the task's error, so that asyncio does not warn when every waiter was cancelled."""
    if not task.cancelled():
        task.exception()
