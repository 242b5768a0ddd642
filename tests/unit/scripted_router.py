"""A router made of recorded bytes, for what the real gateway never does: exact ids, faults, silence."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from macs_zenoh.protocol.decoders import FrameDecoder
from macs_zenoh.protocol.messages import Metadata
from macs_zenoh.protocol.wire import Frame, encode_message
from tests.support.waiting import PATIENCE_S

VECTORS = Path(__file__).parents[1] / "vectors" / "headset"
HEARTBEAT = b'{"messageManager":"HeartbeatHandler"}'


def rows(name: str) -> list[dict[str, Any]]:
    """The rows of one recording."""
    found: list[dict[str, Any]] = json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))
    return found


def recorded(name: str, direction: str) -> list[bytes]:
    """What one side sent in a recording; heartbeats left out."""
    sent = [bytes.fromhex(row["hex"]) for row in rows(name) if row["dir"] == direction and row["hex"]]
    return [data for data in sent if HEARTBEAT not in data]


WELCOME = recorded("handshake_group0", "router->agent")[0]
"""Id 7, configuration request 42, as in every recording."""


def welcome(agent_id: int, request_id: int) -> bytes:
    """The first message on a connection."""
    metadata = Metadata(request_id=request_id, message_manager="AgentConfigurer")
    return encode_message(metadata.encode(), json.dumps({"agentId": agent_id}).encode())


class ScriptedRouter:
    """Accepts connections, sends each one ``greeting`` and keeps every frame that comes, heartbeats apart."""

    def __init__(self, greeting: bytes = WELCOME) -> None:
        self.greeting = greeting
        self.port = 0
        self.frames: list[bytes] = []
        self.heartbeats = 0
        self.connections = 0
        self.ended = 0
        self.answer: Callable[[Frame], Awaitable[bytes | None]] | None = None
        self._changed = asyncio.Event()
        self._writers: list[asyncio.StreamWriter] = []

    async def __aenter__(self) -> ScriptedRouter:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        self.cut()
        await self._server.wait_closed()

    def send(self, data: bytes) -> None:
        """Send to every open connection."""
        for writer in self._writers:
            writer.write(data)

    def cut(self) -> None:
        """Reset every connection."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()

    def close(self) -> None:
        """End every connection in order."""
        for writer in self._writers:
            writer.close()
        self._writers.clear()

    async def until(self, done: Callable[[], bool]) -> None:
        """Wait for a condition on what has come."""

        async def look() -> None:
            while not done():
                self._changed.clear()
                await self._changed.wait()

        await asyncio.wait_for(look(), PATIENCE_S)

    async def received(self, count: int) -> list[bytes]:
        """The first ``count`` frames after the configuration reply."""
        await self.until(lambda: len(self.frames) > count)
        return self.frames[1 : count + 1]

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        decoder = FrameDecoder()
        self.connections += 1
        self._writers.append(writer)
        writer.write(self.greeting)
        try:
            while data := await reader.read(1 << 16):
                for frame in decoder.feed(data):
                    await self._take(frame, writer)
        except ConnectionError:
            pass
        finally:
            self.ended += 1
            self._changed.set()
            writer.close()

    async def _take(self, frame: Frame, writer: asyncio.StreamWriter) -> None:
        if frame.management == HEARTBEAT:
            self.heartbeats += 1
        else:
            self.frames.append(bytes(frame.data))
            if self.answer is not None and (answer := await self.answer(frame)):
                writer.write(answer)
        self._changed.set()
