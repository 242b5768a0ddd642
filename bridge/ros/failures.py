"""Why a call, or another message to an interface node, has no answer: told to who asked, in words of the protocol."""

from __future__ import annotations

from bridge.ros.interface import Registrant, Robot
from macs_zenoh.protocol.messages import ROS, CallFailure, Metadata, NodeType, encode_data
from macs_zenoh.protocol.reading import Message


class CallFailed(Exception):
    """A call has no response; ``kind`` as in `CallFailure`."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.failure = CallFailure(kind, reason)


def answer_metadata(agent_id: int, request: Metadata, *, failed: bool = False) -> Metadata:
    """Of an answer to a request of an interface node: the same node and request id."""
    return Metadata(
        sender_agent_type=ROS,
        sender_agent_id=agent_id,
        request_id=request.request_id,
        message_manager=CallFailure.manager if failed else "",
        node_type=request.node_type,
        node_name=request.node_name,
        data_exchange_type=request.data_exchange_type,
    )


def tell_failure(robot: Robot, message: Message, kind: str, reason: str) -> None:
    """Tell the caller why there is no answer, if it is one that asked for that. Existing programs time out."""
    if message.metadata.message_manager == CallFailure.manager:
        metadata = answer_metadata(robot.agent_id, message.metadata, failed=True)
        robot.send(Registrant.of(message), metadata, encode_data(CallFailure(kind, reason)))
    elif message.metadata.node_type == NodeType.PUBLISHER:
        robot.tell_refused(message, "", kind, reason)
