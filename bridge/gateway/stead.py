"""What a gateway answers in the place of an existing robot program, which does not survive the question.

Such a program's thread for messages ends on all that is no registration and no message of a node. What it offers is
in its configuration; everything else is refused, so that nobody who asks waits for nothing.
"""

from __future__ import annotations

from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol.messages import (
    ROS,
    CallFailure,
    Functionality,
    FunctionalityRequest,
    Metadata,
    NodeType,
    Refusal,
    encode_data,
)
from macs_zenoh.protocol.routing import unicast_key
from macs_zenoh.protocol.wire import Layout, encode_frame, encode_message

from .connection import Connection


class Stead:
    """Answers for the existing robot programs of one gateway."""

    def __init__(self, mesh: Mesh, layout: Layout) -> None:
        self._mesh = mesh
        self._layout = layout

    def answered(self, robot: Connection, message: Metadata, why: str, *, by_id: bool) -> bool:
        """Answer a message that does not reach a robot, if it was a question. Returns whether it has what it wanted.

        Questions that were not sent to the robot's id are refused silently: one message to a group would bring as many
        refusals as it has robots.
        """
        if message.node_name:
            if by_id and message.node_type == NodeType.CLIENT and message.message_manager == CallFailure.manager:
                failure = encode_data(CallFailure("refused", why))
                self._answer(
                    robot,
                    message,
                    Metadata(
                        request_id=message.request_id,
                        message_manager=CallFailure.manager,
                        node_type=message.node_type,
                        node_name=message.node_name,
                        data_exchange_type=message.data_exchange_type,
                    ),
                    failure,
                )
            return False
        answer = Metadata(request_id=message.request_id)
        if message.message_manager == FunctionalityRequest.manager:
            self._answer(robot, message, answer, encode_data(_offers(robot)))
            return True
        if by_id and message.message_manager:
            self._answer(robot, message, answer, encode_data(Refusal(why)))
        return False

    def call(self, robot: Connection, verb: str) -> bytes:
        """The answer to a call of a robot. Raises Refused."""
        if verb == "offers":
            return encode_data(_offers(robot))
        raise Refused(f"robot {robot.agent_id} is an existing program behind a gateway: it does not know {verb[:80]}")

    def _answer(self, robot: Connection, question: Metadata, metadata: Metadata, data: bytes) -> None:
        kind, agent_id = question.sender_agent_type, question.sender_agent_id
        if not kind or not agent_id:
            return  # it has not joined
        message = encode_message(metadata.sent_by(ROS, robot.agent_id).encode(), data)
        frame = encode_frame(kind, (agent_id,), message=message, layout=self._layout)
        self._mesh.put(unicast_key(kind, agent_id, ROS, robot.agent_id), frame, Traffic.CALL)


def _offers(robot: Connection) -> Functionality:
    return robot.peer.functionality or Functionality()
