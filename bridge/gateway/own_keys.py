"""What is declared on the mesh for one TCP agent alone: the inbox of every agent that is no headset, and for existing
robot programs the calls that register interface nodes. Headsets share their gateway's block."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from msgspec import UNSET, structs

from macs_zenoh.directory import Directory
from macs_zenoh.errors import HeldByAnother, Refused
from macs_zenoh.keyexpr import CALL
from macs_zenoh.mesh import Mesh, Subscription
from macs_zenoh.messages import ROS, UNITY, AddNode, GoneAgent, Metadata, RemoveNode, decode_data, encode_data
from macs_zenoh.registrations import AgentKey, check_own
from macs_zenoh.routing import inbox
from macs_zenoh.wire import Layout, encode_message, parse_frame

from .agents import Agents
from .connection import Connection
from .delivery import Delivery

UNSEEN_S = 3.0
"""How long a registrant may not be seen online: news of a token and a call take the same way."""


class OwnKeys:
    """By (type, id), from an agent's configuration to its end."""

    def __init__(self, mesh: Mesh, agents: Agents, directory: Directory, delivery: Delivery, layout: Layout) -> None:
        self._mesh = mesh
        self._agents = agents
        self._directory = directory
        self._delivery = delivery
        self._layout = layout
        self._declared: dict[AgentKey, list[Subscription]] = {}

    def declare(self, connection: Connection) -> None:
        """Listen for an agent under the id that it has. Twice changes nothing."""
        kind, agent_id = connection.key
        if kind == UNITY or connection.key in self._declared:
            return
        declared = [self._mesh.subscribe(inbox(kind, agent_id), self._delivery.inbox)]
        if kind == ROS:
            for verb, message in (("add_node", AddNode), ("remove_node", RemoveNode)):
                calls = CALL.every(type=ROS, id=agent_id, verb=verb)
                declared.append(self._mesh.serve(calls, self._pass_on(connection, message)))
        self._declared[connection.key] = declared

    def undeclare(self, agent: AgentKey) -> None:
        """Listen no more."""
        for declared in self._declared.pop(agent, ()):
            declared.close()

    def close(self) -> None:
        """Listen for nobody."""
        for agent in list(self._declared):
            self.undeclare(agent)

    def _pass_on(
        self, connection: Connection, kind: type[AddNode | RemoveNode]
    ) -> Callable[[str, bytes], Awaitable[bytes]]:
        """Registrations for an existing robot program: passed on as the message it knows, which it never answers."""

        async def deliver(key: str, payload: bytes) -> bytes:
            fields = CALL.parse(key)
            if fields is None or self._agents.find(*connection.key) is not connection:
                raise Refused("the robot is not connected")
            caller = (int(fields["from_type"]), int(fields["from_id"]))
            node = decode_data(kind, parse_frame(payload, self._layout).body)
            check_own(node, caller)
            if isinstance(node, AddNode):
                node = structs.replace(node, unity_cdr=UNSET)  # a robot program passes CDR on as it is
            if isinstance(node, AddNode) and (holder := connection.told.holder(node)) is not None:
                raise HeldByAnother(f"{node.tos_name[:80]} is already registered by another agent", holder)
            if not connection.told.tell(node):
                return b""  # it has that node already
            self._expect(connection, caller)
            metadata = Metadata(*caller, message_manager=kind.manager)
            # written anew: a robot program reads of it what was judged here, however it takes keys named twice
            connection.send_call(encode_message(metadata.encode(), encode_data(node)))
            self._delivery.flush()
            return b""

        return deliver

    def _expect(self, robot: Connection, registrant: AgentKey) -> None:
        """Whoever registers on a robot program is online now or soon. One who left while that was on its way never
        leaves again, so the program is told."""

        def look() -> None:
            if registrant not in self._directory and self._agents.find(*robot.key) is robot:
                robot.tell_gone([GoneAgent(*registrant)])

        if registrant not in self._directory:
            asyncio.get_running_loop().call_later(UNSEEN_S, look)
