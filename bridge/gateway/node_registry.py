"""Interface nodes that a gateway's agents register at robots: how many they may have, and who is told what becomes of
them.

What is asked of robots, again and again until they answer, is in `macs_zenoh.registration_calls`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from msgspec import structs

from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.budget import Budget
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.limits import (
    NAMED_EACH,
    NAMED_IN_ALL,
    NAMED_PER_ADDRESS,
    NODES_EACH,
    NODES_IN_ALL,
    NODES_PER_ADDRESS,
)
from macs_zenoh.protocol.messages import ROS, AddNode, Metadata, NodeRefused, NodeType, RemoveNode
from macs_zenoh.protocol.recipient import to_agent
from macs_zenoh.protocol.registrations import AgentKey
from macs_zenoh.protocol.tcp_agent import Registering, Withdrawn
from macs_zenoh.protocol.wire import Layout
from macs_zenoh.registration_calls import RobotCalls, StreamChanges

from .agents import Agents
from .connection import Connection
from .record import Record


class NodeRegistry:
    """Those of one gateway's agents."""

    def __init__(
        self,
        mesh: Mesh,
        directory: Directory,
        layout: Layout,
        agents: Agents,
        record: Record,
        *,
        on_streams: Callable[[StreamChanges], None],
        tell: bool,
    ) -> None:
        """``on_streams`` hears which topics of robots somebody here receives; ``tell``: agents hear of refusals."""
        self._agents = agents
        self._record = record
        self._tell = tell
        self.robots = RobotCalls(
            mesh, directory, layout, on_streams=on_streams, on_refused=self.refused, together=True
        )
        self.nodes = Budget("interface nodes", each=NODES_EACH, per_address=NODES_PER_ADDRESS, total=NODES_IN_ALL)
        named = "robots and groups named in registrations"
        self.named = Budget(named, each=NAMED_EACH, per_address=NAMED_PER_ADDRESS, total=NAMED_IN_ALL)

    def knows(self, connection: Connection, metadata: Metadata) -> bool:
        """Whether an agent registered a message's node on the robot that sends it."""
        sender = metadata.sender_agent_type, metadata.sender_agent_id
        return sender[0] == ROS and self.robots.registered(connection.key, metadata, int(sender[1] or 0))

    def register(self, connection: Connection, event: Registering) -> None:
        """An agent registers on a node of robots, or takes that back."""
        kind, agent_id = connection.key  # it may have become another one than when it said this
        node = structs.replace(event.node, registrant_agent_type=kind, registrant_agent_id=agent_id)
        if isinstance(node, AddNode):
            if not self._allowed(connection, node, event):
                return
            if connection.recipient.existing and (other := connection.recipient.other_type(node)) is not None:
                self.robots.take_back_all(connection.key, other, node.node_name)
                connection.recipient.unregistered(node.node_name, other)
            connection.recipient.registered(node)
            if node.node_type == NodeType.SUBSCRIBER:
                connection.open_direct()
            if not connection.peer.extensions:  # an existing program, which cannot say it itself
                node = structs.replace(node, unity_cdr=True)
        self.robots.register(node, event.robot_ids, event.groups)
        self._note(connection, node, event)
        if not isinstance(node, AddNode) and self.robots.find(connection.key, node.node_type, node.node_name) is None:
            connection.recipient.unregistered(node.node_name, node.node_type)
        self._count(connection)

    def _allowed(self, connection: Connection, node: AddNode, event: Registering) -> bool:
        """Whether there is room for it; else that is told."""
        why = None
        if not connection.recipient.is_registered(node):
            why = self.nodes.judge(connection, connection.host)
        naming = self.robots.naming(node, event.robot_ids, event.groups)
        why = why or self.named.judge(connection, connection.host, naming)
        if why is not None:
            connection.complain("too_many_nodes", why)
            self.robots.refuse(node, next(iter(event.robot_ids), 0), why)
        return why is None

    def withdraw(self, connection: Connection, event: Withdrawn) -> None:
        """Registrations are not permitted any more."""
        for node, why in event.nodes:
            self.robots.take_back_all(connection.key, node.node_type, node.node_name)
            connection.recipient.unregistered(node.node_name, node.node_type)
            self.refused(connection.key, NodeRefused(0, node.node_type, node.node_name, node.tos_name, why))
        self._count(connection)

    def refused(self, agent: AgentKey, refused: NodeRefused) -> None:
        """A registration of an agent was refused: it is told."""
        connection = self._agents.find(*agent)
        if connection is None:
            return
        what = f"type {refused.node_type} {refused.tos_name or refused.node_name} at robot {refused.robot_id}"
        self._record.agent("register", connection, what, refused.reason)
        connection.peer.registration_refused(refused)
        if self._tell:
            connection.send_call(to_agent(refused))

    def leave(self, connection: Connection, *, was_online: bool) -> None:
        """An agent has left: what it had is forgotten."""
        self.nodes.set(connection, connection.host, 0)
        self.named.set(connection, connection.host, 0)
        if was_online:
            self.robots.leave(connection.key)

    @contextmanager
    def moved(self, connection: Connection) -> Iterator[None]:
        """Within it an agent comes to have another address: what it had counts for that."""
        nodes, named = self.nodes.of(connection), self.named.of(connection)
        self.leave(connection, was_online=False)
        yield
        self.nodes.set(connection, connection.host, nodes)
        self.named.set(connection, connection.host, named)

    def _count(self, connection: Connection) -> None:
        self.nodes.set(connection, connection.host, connection.recipient.node_count)
        self.named.set(connection, connection.host, self.robots.named(connection.key))

    def _note(self, connection: Connection, node: AddNode | RemoveNode, event: Registering) -> None:
        if not self._record.is_kept:
            return
        at = [f"robot {each}" for each in event.robot_ids] + [f"group {each}" for each in event.groups]
        name = node.tos_name if isinstance(node, AddNode) else node.node_name
        verb = "register" if isinstance(node, AddNode) else "deregister"
        self._record.agent(verb, connection, f"type {node.node_type} {name} at {', '.join(at) or 'nobody'}")
