"""TCP agents by hand, for what the well-behaved headset does not do."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from bridge.gateway import Gateway
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import (
    Configuration,
    Metadata,
    NodeType,
    Welcome,
    decode_data,
    encode_management,
    node_name,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message, split_message
from tests.support.waiting import PATIENCE_S


class Socket:
    """One connection to a gateway."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self._decoder = MessageDecoder()
        self._messages: list[bytes] = []
        self.id = 0

    async def message(self) -> tuple[Metadata, bytes]:
        """The next message; ConnectionError at the end of the stream."""
        metadata, body = await self.raw_message()
        return Metadata.decode(metadata), body

    async def raw_message(self) -> tuple[bytes, bytes]:
        """The same with its metadata as it came."""
        while not self._messages:
            data = await asyncio.wait_for(self.reader.read(65536), PATIENCE_S)
            if not data:
                raise ConnectionError
            self._messages += self._decoder.feed(data)
        metadata, body = split_message(self._messages.pop(0))
        return metadata, bytes(body)

    async def greet(self) -> None:
        """Take the first message, which gives the id."""
        metadata, body = await self.message()
        assert metadata.message_manager == Welcome.manager
        self.id = decode_data(Welcome, body).agent_id

    def configure(self, *, agent_type: int = 2, group: int = 0) -> None:
        """Send the configuration reply."""
        configuration = Configuration(agent_type=agent_type, agent_id=self.id, group_id=group, request_id=1)
        self.writer.write(encode_frame(management=encode_management(configuration)))

    def ask_online(self, number: int) -> None:
        """Ask who is online, with this request id."""
        management = b'{"messageManager":"OnlineAgentsGetter"}'
        asked = encode_message(Metadata(request_id=number).encode())
        self.writer.write(encode_frame(management=management, message=asked))

    def command(self, robot: int, topic: str, kind: str, data: bytes) -> None:
        """Send a robot something for a topic."""
        metadata = Metadata(node_type=NodeType.PUBLISHER, node_name=node_name(topic), data_exchange_type=kind)
        self.writer.write(encode_frame(1, (robot,), message=encode_message(metadata.encode(), data)))

    async def online(self) -> tuple[list[int], list[int]]:
        """Ask who is online: an answer also shows that everything before was dealt with."""
        self.ask_online(7)
        while True:
            metadata, body = await self.message()
            if metadata.request_id == 7 and not metadata.message_manager:
                answer = json.loads(body)
                return answer["rosAgentIds"], answer["unityAgentIds"]


@asynccontextmanager
async def socket(gateway: Gateway) -> AsyncIterator[Socket]:
    """A connection that has been greeted."""
    reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
    agent = Socket(reader, writer)
    try:
        await agent.greet()
        yield agent
    finally:
        writer.close()
