"""What carries a headset's bytes: a TCP socket, the same over TLS, or a WebSocket."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from dataclasses import dataclass
from typing import Any, Protocol

from macs_zenoh.errors import MissingExtra, UsageError
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.websocket import MESSAGE_BYTES, SUBPROTOCOL, WEBSOCKET_PATH

HIGH_BYTES = 256 << 10


@dataclass(frozen=True)
class Way:
    """How a gateway is reached. ``tls`` and its authority's file, None for those that the system trusts."""

    websocket: bool = False
    tls: bool = False
    authority: str | None = None

    def context(self) -> ssl.SSLContext | None:
        """What TLS believes. Raises UsageError: the file cannot be used."""
        if not self.tls:
            return None
        try:
            context = ssl.create_default_context(cafile=self.authority)
        except (OSError, ssl.SSLError) as error:
            raise UsageError(f"{self.authority}: {error.strerror or error}") from error
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context


TCP = Way()


class Stream(Protocol):
    """Bytes in both directions."""

    async def read(self) -> bytes:
        """What comes next; nothing at the end. Raises OSError."""

    def write(self, data: bytes) -> None:
        """Send in order, now or soon."""

    @property
    def unsent(self) -> int:
        """How many bytes wait here."""

    async def drain(self) -> None:
        """Wait until few of them do. Raises OSError."""

    @property
    def closing(self) -> bool:
        """Whether it has ended, or is about to."""

    def finish(self) -> None:
        """Send what is written, and say that no more comes."""

    def abort(self) -> None:
        """End it without a word."""


async def open_stream(host: str, port: int, way: Way) -> Stream:
    """Connect. Raises OSError, UsageError, MissingExtra."""
    if way.websocket:
        return await _WebSocketStream.open(host, port, way)
    context = way.context()
    reader, writer = await asyncio.open_connection(host, port, ssl=context)
    raw = writer.get_extra_info("socket")
    if raw is not None:
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return _TcpStream(reader, writer)


class _TcpStream:
    READ_BYTES = 256 << 10

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    async def read(self) -> bytes:
        try:
            return await self._reader.read(self.READ_BYTES)
        except OSError:
            came = bytes(self._reader._buffer)  # type: ignore[attr-defined]
            if not came:
                raise
            self._reader._buffer.clear()  # type: ignore[attr-defined]
            return came  # before the connection was reset: why, perhaps

    def write(self, data: bytes) -> None:
        self._writer.write(data)

    @property
    def unsent(self) -> int:
        return self._writer.transport.get_write_buffer_size()

    async def drain(self) -> None:
        await self._writer.drain()

    @property
    def closing(self) -> bool:
        return self._writer.is_closing()

    def finish(self) -> None:
        # half-closing first: closing a socket with unread data would reset it and lose our last frames
        if self._writer.can_write_eof():
            self._writer.write_eof()
        else:  # over TLS there are no halves
            self._writer.close()

    def abort(self) -> None:
        self._writer.transport.abort()


class _WebSocketStream:
    """aiohttp's client, whose sending is a coroutine: a task sends what is written, in order."""

    def __init__(self, session: Any, socket: Any) -> None:
        self._session = session
        self._socket = socket
        self._waiting: list[bytes] = []
        self.unsent = 0
        self._written = asyncio.Event()
        self._room = asyncio.Event()
        self._room.set()
        self._finishing = False
        self._sending = asyncio.get_running_loop().create_task(self._send())

    @classmethod
    async def open(cls, host: str, port: int, way: Way) -> _WebSocketStream:
        try:
            import aiohttp
        except ModuleNotFoundError as error:
            raise MissingExtra("a WebSocket", "aiohttp", "web") from error
        context = way.context()
        session = aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=context if context is not None else True))
        scheme = "wss" if way.tls else "ws"
        url = f"{scheme}://{joined(host, port)}{WEBSOCKET_PATH}"
        try:
            socket = await session.ws_connect(
                url, protocols=(SUBPROTOCOL,), max_msg_size=0, compress=0, autoclose=True
            )
        except aiohttp.ClientError as error:
            await session.close()
            raise OSError(f"no WebSocket: {error}") from error
        except BaseException:
            await session.close()
            raise
        return cls(session, socket)

    async def read(self) -> bytes:
        from aiohttp import WSMsgType

        while True:
            message = await self._socket.receive()
            if message.type is WSMsgType.BINARY:
                if message.data:
                    return bytes(message.data)
            elif message.type not in (WSMsgType.TEXT, WSMsgType.PING, WSMsgType.PONG):
                return b""

    def write(self, data: bytes) -> None:
        self._waiting.append(data)
        self.unsent += len(data)
        if self.unsent > HIGH_BYTES:
            self._room.clear()
        self._written.set()

    async def drain(self) -> None:
        await self._room.wait()

    @property
    def closing(self) -> bool:
        return bool(self._socket.closed) or self._finishing

    def finish(self) -> None:
        self._finishing = True
        self._written.set()

    def abort(self) -> None:
        self._finishing = True
        self._sending.cancel()
        response = self._socket._response  # its socket has no way to end without a goodbye
        if response.connection is not None and response.connection.transport is not None:
            response.connection.transport.abort()
        response.close()

    async def _send(self) -> None:
        try:
            while True:
                await self._written.wait()
                self._written.clear()
                waiting, self._waiting = self._waiting, []
                data = waiting[0] if len(waiting) == 1 else b"".join(waiting)
                for begin in range(0, len(data), MESSAGE_BYTES):
                    await self._socket.send_bytes(data[begin : begin + MESSAGE_BYTES])
                self.unsent = sum(map(len, self._waiting))
                if self.unsent <= HIGH_BYTES:
                    self._room.set()
                if self._finishing and not self._waiting:
                    await self._socket.close()
                    return
        except (ConnectionError, OSError):
            return  # the reader hears of it
        finally:
            self._room.set()
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.shield(self._session.close())
