"""What is declared on the mesh for one TCP agent alone: the inbox of every agent that is no headset, and for robot
programs the calls. Headsets share their gateway's block.

A registration is passed on as the message that existing robots know, which they never answer, if they survive it;
other calls are answered in their stead.
"""

from __future__ import annotations

import asyncio

from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh, Subscription
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.keyexpr import CALL
from macs_zenoh.protocol.limits import CALL_BYTES
from macs_zenoh.protocol.messages import ROS, UNITY, AddNode, GoneAgent, RemoveNode, decode_data
from macs_zenoh.protocol.registrations import AgentKey, check_own
from macs_zenoh.protocol.routing import inbox
from macs_zenoh.protocol.wire import Layout, parse_frame

from .agents import Agents
from .connection import Connection
from .delivery import Delivery
from .stead import Stead

REGISTRATIONS: dict[str, type[AddNode | RemoveNode]] = {"add_node": AddNode, "remove_node": RemoveNode}

UNSEEN_S = 3.0
"""How long a registrant may not be seen online: news of a token and a call take the same way."""


class AgentDeclarations:
    """By (type, id), from an agent's configuration to its end."""

    def __init__(
        self, mesh: Mesh, agents: Agents, directory: Directory, delivery: Delivery, layout: Layout, stead: Stead
    ) -> None:
        self._mesh = mesh
        self._agents = agents
        self._directory = directory
        self._delivery = delivery
        self._layout = layout
        self._stead = stead
        self._declared: dict[AgentKey, list[Subscription]] = {}

    def declare(self, connection: Connection) -> None:
        """Listen for an agent under the id that it has. Twice changes nothing."""
        kind, agent_id = connection.key
        if kind == UNITY or connection.key in self._declared:
            return
        declared = [self._mesh.subscribe(inbox(kind, agent_id), self._delivery.inbox)]
        if kind == ROS:
            calls = CALL.every(type=ROS, id=agent_id)
            called = self._mesh.serve(
                calls, lambda key, payload: self._called(connection, key, payload), most_bytes=CALL_BYTES
            )
            declared.append(called)
        self._declared[connection.key] = declared

    def undeclare(self, agent: AgentKey) -> None:
        """Listen no more."""
        for declared in self._declared.pop(agent, ()):
            declared.close()

    def close(self) -> None:
        """Listen for nobody."""
        for agent in list(self._declared):
            self.undeclare(agent)

    async def _called(self, robot: Connection, key: str, payload: bytes) -> bytes:
        fields = CALL.parse(key)
        if fields is None or self._agents.find(*robot.key) is not robot:
            raise Refused("the robot is not connected")
        verb, caller = fields.verb, fields.sender
        kind = REGISTRATIONS.get(verb)
        if kind is None:
            return self._stead.call(robot, verb)
        node = decode_data(kind, parse_frame(payload, self._layout).body)
        check_own(node, caller)
        self._register(robot, node)
        return b""

    def _register(self, robot: Connection, node: AddNode | RemoveNode) -> None:
        """Tell a robot of a registration or its end. Raises Refused for what it would not survive."""
        message = robot.recipient.tell(node, robot.peer.functionality)
        if message is not None:
            self._expect(robot, (node.registrant_agent_type, node.registrant_agent_id))
            robot.send_call(message)

    def _expect(self, robot: Connection, registrant: AgentKey) -> None:
        """Whoever registers on a robot program is online now or soon. One who left while that was on its way never
        leaves again, so the program is told."""

        def look() -> None:
            if registrant not in self._directory and self._agents.find(*robot.key) is robot:
                robot.tell_gone([GoneAgent(*registrant)])

        if registrant not in self._directory:
            asyncio.get_running_loop().call_later(UNSEEN_S, look)
