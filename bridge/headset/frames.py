"""What a headset puts on the wire, byte for byte as the C# program does. Pure: values in, frames out.

The C# program writes compact JSON in an order of its own: the manager comes first in management data, but last in
the configuration reply, and before the request id in metadata. Routers accept any order; the tests and the
gateway's users want exactly the bytes that a real headset sends, so they are spelled out here
(``tests/vectors/headset``).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import msgspec

from macs_zenoh.protocol.messages import (
    EVERYBODY,
    ROS,
    UNITY,
    AddNode,
    Configuration,
    GoOffline,
    Heartbeat,
    NodeType,
    OnlineRequest,
    Registration,
    RemoveNode,
    encode_data,
    node_name,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message

DEFAULT_BUFFER_SIZE = 10
"""Messages that robot and gateway hold for one node, unless asked otherwise; the C# program's default."""


@dataclass(frozen=True)
class NodeSpec:
    """An interface node as a headset asks for it: what a registration says.

    ``data_type`` is ``pkg/Name``, ``buffer_size`` counts messages. ``drop_new`` chooses what a full queue drops.
    """

    kind: NodeType
    tos_name: str
    data_type: str
    buffer_size: int = DEFAULT_BUFFER_SIZE
    drop_new: bool = False
    latched: bool = False
    name: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", node_name(self.tos_name))


def configuration(
    agent_id: int,
    group: int,
    request_id: int,
    extensions: int = 0,
    token: str | None = None,
    session: str | None = None,
    received: int = 0,
) -> bytes:
    """The answer to the router's first message: who I am. ``request_id`` is that message's.

    The rest is what the C# program does not say. ``extensions`` is the version of our extensions that this headset
    understands, by ``token`` it is let in. ``session`` says that it comes back when its connection ends; with the
    secret of a session that it is back, after ``received`` messages.
    """
    management: dict[str, object] = {
        "agentType": UNITY,
        "agentId": agent_id,
        "groupId": group,
        "requestId": request_id,
        "messageManager": Configuration.manager,
    }
    if extensions:
        management["extensions"] = extensions
    if token is not None:
        management["token"] = token
    if session is not None:
        management |= {"session": session, "received": received}
    return _management_frame(management)


def heartbeat(received: int | None = None) -> bytes:
    """I am still here: due after 5 s without other output. ``received``: so many messages of the session have come."""
    management: dict[str, object] = {"messageManager": Heartbeat.manager}
    if received is not None:
        management["received"] = received
    return _management_frame(management)


def go_offline(agent_id: int) -> bytes:
    """I leave. The router tells everybody at once."""
    return _management_frame({"messageManager": GoOffline.manager, "agentId": agent_id})


def online_request(agent_id: int, request_id: int) -> bytes:
    """Who is online? The answer carries the same request id."""
    management = {"messageManager": OnlineRequest.manager, "agentType": UNITY, "agentId": agent_id}
    return _management_frame(management, encode_message(_metadata(agent_id, request_id=request_id)))


def management(agent_id: int, request_id: int, manager: str, data: Mapping[str, object]) -> bytes:
    """Management data of a manager that somebody added to the gateway (docs/managers.md)."""
    return _management_frame(
        {**data, "messageManager": manager}, encode_message(_metadata(agent_id, request_id=request_id))
    )


def registration(agent_id: int, node: NodeSpec, agents: Collection[int], groups: Collection[int]) -> bytes:
    """Ask these robots, and the robots of these groups, for an interface node. Any number of both."""
    request = AddNode(
        registrant_agent_type=UNITY,
        registrant_agent_id=agent_id,
        node_type=node.kind,
        node_name=node.name,
        tos_name=node.tos_name,
        data_exchange_type=node.data_type,
        buffer_size=node.buffer_size,
        drop_new=node.drop_new,
        is_latched=node.latched,
    )
    return _node_request(agent_id, node, agents, groups, AddNode.manager, encode_data(request))


def deregistration(agent_id: int, node: NodeSpec, agents: Collection[int], groups: Collection[int]) -> bytes:
    """Take me off this node at these robots and at the robots of these groups."""
    request = RemoveNode(
        registrant_agent_type=UNITY, registrant_agent_id=agent_id, node_type=node.kind, node_name=node.name
    )
    return _node_request(agent_id, node, agents, groups, RemoveNode.manager, encode_data(request))


def node_data(
    agent_id: int,
    node: NodeSpec,
    cdr: bytes | bytearray | memoryview,
    agents: Collection[int],
    groups: Collection[int] = (),
    *,
    request_id: int = 0,
    manager: str = "",
    clock: str = "",
) -> bytes:
    """Data of an interface node to robots: a topic's message (type 2), a request (3) or a response (4), as CDR.

    ``manager`` is empty in what the C# program sends; see `protocol.messages.CallFailure` and docs/actions.md. With a
    ``clock``, the request id is the time on it at which a command was made.
    Raises TooManyDestinations above 10 agents or 10 groups.
    """
    metadata = _metadata(
        agent_id,
        manager=manager,
        request_id=request_id,
        node_type=node.kind,
        name=node.name,
        data_type=node.data_type,
        clock=clock,
    )
    return encode_frame(ROS, tuple(agents), tuple(groups), message=encode_message(metadata, cdr))


def plain_data(
    agent_id: int,
    data: bytes | bytearray | memoryview,
    *,
    to_type: int = EVERYBODY,
    ids: Collection[int] = (),
    groups: Collection[int] = (),
    manager: str = "",
    request_id: int = 0,
) -> bytes:
    """Any data to agents of one type, by id and by group; type 0 goes to everybody.

    Raises TooManyDestinations above 10 ids or 10 groups, OutOfRange for a number that does not fit.
    """
    metadata = _metadata(agent_id, manager=manager, request_id=request_id)
    return encode_frame(to_type, tuple(ids), tuple(groups), message=encode_message(metadata, data))


def _node_request(
    agent_id: int, node: NodeSpec, agents: Collection[int], groups: Collection[int], manager: str, request: bytes
) -> bytes:
    management = {
        "messageManager": Registration.manager,
        "registrantAgentId": agent_id,
        "registrarAgentIds": list(agents),
        "registrarGroupIds": list(groups),
        "nodeType": node.kind,
        "nodeName": node.name,
        "tosName": node.tos_name,
        "dataExchangeType": node.data_type,
    }
    return _management_frame(management, encode_message(_metadata(agent_id, manager=manager), request))


def _management_frame(management: dict[str, object], message: bytes | None = None) -> bytes:
    encoded = msgspec.json.encode(management)
    if message is None:
        return encode_frame(management=encoded)
    return encode_frame(management=encoded, message=message)


def _metadata(
    agent_id: int,
    *,
    manager: str = "",
    request_id: int = 0,
    node_type: int = 0,
    name: str = "",
    data_type: str = "",
    clock: str = "",
) -> bytes:
    metadata = {
        "senderAgentType": UNITY,
        "senderAgentId": agent_id,
        "messageManager": manager,
        "requestId": request_id,
        "nodeType": node_type,
        "nodeName": name,
        "dataExchangeType": data_type,
    }
    if clock:
        metadata["clock"] = clock
    return msgspec.json.encode(metadata)
