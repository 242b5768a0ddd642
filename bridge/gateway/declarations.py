"""What is declared on the mesh for one TCP agent alone: the inbox of every agent that is no headset, and for robot
programs the calls. Headsets share their gateway's block.

A registration is passed on as the message that existing robots know, which they never answer, if they survive it;
other calls are answered in their stead.
"""

from __future__ import annotations

import asyncio

from msgspec import UNSET, structs

from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh, Subscription
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.keyexpr import CALL
from macs_zenoh.protocol.messages import ROS, UNITY, AddNode, GoneAgent, Metadata, RemoveNode, decode_data, encode_data
from macs_zenoh.protocol.registrations import AgentKey, check_own
from macs_zenoh.protocol.routing import inbox
from macs_zenoh.protocol.wire import Layout, encode_message, parse_frame

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
            declared.append(self._mesh.serve(calls, lambda key, payload: self._called(connection, key, payload)))
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
        if isinstance(node, AddNode):
            node = structs.replace(node, unity_cdr=UNSET)  # a robot program passes CDR on as it is
        known, offered = robot.robot_nodes, robot.peer.functionality
        if isinstance(node, AddNode):
            to_tell = known.add(node, offered, existing=robot.existing)
        else:
            to_tell = known.remove(node)
        if not to_tell:
            return
        robot.nodes_change()
        caller = (node.registrant_agent_type, node.registrant_agent_id)
        self._expect(robot, caller)
        metadata = Metadata(*caller, message_manager=node.manager)
        # written anew: a robot program reads of it what was judged here, however it takes keys named twice
        robot.send_call(encode_message(metadata.encode(), encode_data(node)))

    def _expect(self, robot: Connection, registrant: AgentKey) -> None:
        """Whoever registers on a robot program is online now or soon. One who left while that was on its way never
        leaves again, so the program is told."""

        def look() -> None:
            if registrant not in self._directory and self._agents.find(*robot.key) is robot:
                robot.tell_gone([GoneAgent(*registrant)])

        if registrant not in self._directory:
            asyncio.get_running_loop().call_later(UNSEEN_S, look)
