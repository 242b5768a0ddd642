"""A recorded robot behind a gateway, over TCP, as existing robot programs are."""

from __future__ import annotations

import asyncio
import logging

from bridge.headset.connection import Connection
from bridge.replay.recorded import RecordedRobot, RecordedTopic
from macs_zenoh.errors import MacsError, Unreachable, WireError
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AddNode,
    AgentsGone,
    Configuration,
    Functionality,
    FunctionalityRequest,
    Heartbeat,
    Metadata,
    NodeType,
    RemoveNode,
    StreamData,
    Welcome,
    decode_data,
    encode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.offers import absolute, short_type
from macs_zenoh.protocol.schemas import full_type, unity_differs
from macs_zenoh.protocol.wire import MAX_FRAME_BYTES, encode_frame, encode_message, split_message

log = logging.getLogger("macs.replay")

GREETING_S = 10.0
HEARTBEAT_S = 4.0
UNSENT_BYTES = 8 << 20
"""So much may wait for a gateway that takes it too slowly; more is lost, and counted."""


class TcpRobot:
    """One recorded robot over one connection. All methods belong to the loop."""

    def __init__(self, recorded: RecordedRobot) -> None:
        self.recorded = recorded
        self.id = 0
        self.lost = 0
        self._connection: Connection | None = None
        self._registrants: dict[str, set[tuple[int, int]]] = {topic: set() for topic in recorded.topics}
        self._tasks: list[asyncio.Task[None]] = []
        self.ended = asyncio.Event()
        self.why = ""

    async def connect(self, host: str, port: int) -> None:
        """Be online there. Raises Unreachable, where the gateway lets no robot in (--robots) as well."""
        connection = await Connection.open(host, port, timeout_s=GREETING_S, max_message_bytes=MAX_FRAME_BYTES)
        self._connection = connection
        metadata, data = split_message(await connection.receive_first(GREETING_S))
        self.id = decode_data(Welcome, data).agent_id
        offered = self.recorded.offers()
        configuration = Configuration(
            ROS,
            self.id,
            self.recorded.group,
            Metadata.decode(metadata).request_id,
            Functionality(offered.subscribers, offered.publishers, offered.services),
        )
        await connection.send(encode_frame(management=encode_management(configuration)))
        self._tasks = [asyncio.create_task(self._read(connection)), asyncio.create_task(self._beat(connection))]

    def put(self, topic: RecordedTopic, cdr: bytes) -> None:
        """A message is due."""
        if topic.is_latched:
            topic.last = cdr
        self._put(topic, cdr, self._registrants[topic.name])

    async def close(self) -> None:
        """Leave."""
        for task in self._tasks:
            task.cancel()
        if self._connection is not None:
            await self._connection.close()

    def _put(self, topic: RecordedTopic, cdr: bytes, receivers: set[tuple[int, int]]) -> None:
        if not receivers or self._connection is None or self.ended.is_set():
            return
        if self._connection.unsent > UNSENT_BYTES:
            self.lost += 1
            return
        by_type: dict[str, list[int]] = {}
        for agent_type, agent_id in sorted(receivers):
            by_type.setdefault(str(agent_type), []).append(agent_id)
        metadata = Metadata(
            ROS,
            self.id,
            message_manager=StreamData.manager,
            node_type=NodeType.SUBSCRIBER,
            node_name=node_name(topic.name),
            data_exchange_type=short_type(topic.type),
        )
        frame = encode_frame(
            management=encode_management(StreamData(by_type)), message=encode_message(metadata.encode(), cdr)
        )
        self._connection.put(frame)

    async def _beat(self, connection: Connection) -> None:
        while True:
            await asyncio.sleep(HEARTBEAT_S)
            try:
                await connection.send(encode_frame(management=encode_management(Heartbeat())))
            except Unreachable:
                return

    async def _read(self, connection: Connection) -> None:
        try:
            while True:
                message = await connection.receive()
                try:
                    self._take(*split_message(message))
                except WireError as error:
                    log.warning("a message of the gateway cannot be read: %s", error)
        except MacsError as error:
            self.why = str(error)
            self.ended.set()

    def _take(self, raw: bytes, data: memoryview) -> None:
        metadata = Metadata.decode(raw)
        manager = metadata.message_manager
        if manager == Welcome.manager:
            self.id = decode_data(Welcome, data).agent_id
        elif manager == AddNode.manager:
            self._add(decode_data(AddNode, data))
        elif manager == RemoveNode.manager:
            gone = decode_data(RemoveNode, data)
            for topic, registrants in self._registrants.items():
                if node_name(topic) == gone.node_name and gone.node_type == NodeType.SUBSCRIBER:
                    registrants.discard((gone.registrant_agent_type, gone.registrant_agent_id))
        elif manager == AgentsGone.manager:
            left = {(each.agent_type, each.agent_id) for each in decode_data(AgentsGone, data).agents}
            for registrants in self._registrants.values():
                registrants -= left
        elif manager == FunctionalityRequest.manager and self._connection is not None:
            answer = encode_message(
                Metadata(request_id=metadata.request_id).encode(), encode_data(self.recorded.offers())
            )
            to = (metadata.sender_agent_type or 0, metadata.sender_agent_id or 0)
            self._connection.put(encode_frame(to[0], (to[1],), message=answer))

    def _add(self, request: AddNode) -> None:
        """Nothing can be refused here: who wants what is not recorded gets nothing, and it is said."""
        topic = self.recorded.topics.get(absolute(request.tos_name))
        who = (request.registrant_agent_type, request.registrant_agent_id)
        if request.node_type != NodeType.SUBSCRIBER or topic is None:
            log.info("%s/%s wants %s, which is not in the recording", *who, request.tos_name)
        elif full_type(request.data_exchange_type) != topic.type:
            log.warning("%s has type %s, not %s", topic.name, topic.type, request.data_exchange_type)
        elif who[0] == UNITY and unity_differs(topic.type, self.recorded.definitions):
            log.warning("%s is not played to headsets: Unity's serializer may read its type otherwise", topic.name)
        else:
            is_new = who not in self._registrants[topic.name]
            self._registrants[topic.name].add(who)
            if is_new and topic.last is not None:
                self._put(topic, topic.last, {who})
