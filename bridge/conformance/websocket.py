"""WebSockets before the kit's port: each leads to a TCP connection there, as pieces of the same stream of bytes."""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress

from aiohttp import WSMsgType, web

from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.websocket import MESSAGE_BYTES, SUBPROTOCOL, WEBSOCKET_PATH

_READ_BYTES = 64 << 10


class WebSockets:
    """Listens on a port for a headset that comes by WebSocket, and passes on what it says and is told."""

    def __init__(self, host: str, port: int, to_port: int) -> None:
        self.port = port
        self._host = host
        self._to_port = to_port
        app = web.Application()
        app.router.add_get(WEBSOCKET_PATH, self._come)
        self._runner = web.AppRunner(app, handle_signals=False, access_log=None, shutdown_timeout=0.1)

    async def __aenter__(self) -> WebSockets:
        await self._runner.setup()
        site = web.TCPSite(self._runner, self._host, self.port)
        try:
            await site.start()
        except OSError as error:
            raise Unreachable(joined(self._host, self.port), error.strerror or str(error)) from error
        self.port = self._runner.addresses[0][1]
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._runner.cleanup()

    async def _come(self, request: web.Request) -> web.WebSocketResponse:
        stream = web.WebSocketResponse(protocols=(SUBPROTOCOL,), compress=False, max_msg_size=MESSAGE_BYTES + 1)
        await stream.prepare(request)
        reader, writer = await asyncio.open_connection(self._host, self._to_port)
        raw: socket.socket = writer.get_extra_info("socket")
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        telling = asyncio.create_task(_tell(stream, reader, request.transport))
        try:
            async for message in stream:
                if message.type is not WSMsgType.BINARY:
                    break
                writer.write(message.data)
                with suppress(ConnectionError):
                    await writer.drain()
        finally:
            writer.close()
            telling.cancel()
        return stream


async def _tell(
    stream: web.WebSocketResponse, reader: asyncio.StreamReader, transport: asyncio.BaseTransport | None
) -> None:
    """What the kit says; its connection's end is the WebSocket's, in order or not."""
    try:
        while data := await reader.read(_READ_BYTES):
            await stream.send_bytes(data)
        await stream.close()
    except ConnectionError:
        if isinstance(transport, asyncio.Transport):
            transport.abort()
