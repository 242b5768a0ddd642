"""What an existing robot program was told of nodes: it answers nothing, so its gateway keeps account. Pure."""

from __future__ import annotations

from collections.abc import Iterable

from macs_zenoh.messages import AddNode, GoneAgent, NodeType, RemoveNode
from macs_zenoh.registrations import AgentKey, NodeKey


class Told:
    """Registrations by agent and node."""

    def __init__(self) -> None:
        self._of: dict[AgentKey, dict[NodeKey, AddNode]] = {}
        self._services: dict[str, AgentKey] = {}

    def tell(self, node: AddNode | RemoveNode) -> bool:
        """Whether the program has to be told: it makes a second ROS node of a registration heard twice."""
        agent, key = _agent(node), (node.node_type, node.node_name)
        nodes = self._of.get(agent, {})
        if isinstance(node, RemoveNode):
            nodes.pop(key, None)
            if not nodes:
                self._of.pop(agent, None)
            if self._services.get(node.node_name) == agent and node.node_type == NodeType.SERVICE:
                del self._services[node.node_name]
            return True
        if nodes.get(key) == node:
            return False
        self._of.setdefault(agent, {})[key] = node
        if node.node_type == NodeType.SERVICE:
            self._services[node.node_name] = agent
        return True

    def holder(self, node: AddNode) -> AgentKey | None:
        """Another agent that serves what this one wants to serve: a ROS service has one server."""
        holder = self._services.get(node.node_name) if node.node_type == NodeType.SERVICE else None
        return holder if holder != _agent(node) else None

    def untell(self, gone: Iterable[GoneAgent]) -> None:
        """A program that hears of these takes them off its nodes."""
        if self._of:
            for agent in gone:
                for node in list(self._of.get((agent.agent_type, agent.agent_id), {}).values()):
                    self.tell(RemoveNode(agent.agent_type, agent.agent_id, node.node_type, node.node_name))

    def registrants(self) -> list[GoneAgent]:
        """Who is registered."""
        return [GoneAgent(*agent) for agent in self._of]


def _agent(node: AddNode | RemoveNode) -> AgentKey:
    return node.registrant_agent_type, node.registrant_agent_id
