"""A WebSocket as an agent's connection: its binary messages are pieces of the byte stream.

aiohttp reads WebSocket. What it does not bound is bounded here: how many pings are answered, and how many messages say
nothing. What is written goes past aiohttp, as whole WebSocket messages, into the transport below it: a task for each
message would cost more than the message.
"""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable, Coroutine, Generator, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, cast

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.websocket import MESSAGE_BYTES
from macs_zenoh.protocol.wire import MACS

from .connection import Connection
from .shares import Rounds, Share
from .writer import joined

PINGS_PER_S = 10.0
"""Pings and empty messages; who sends more is closed."""
CRUMB_BYTES = MACS.header_bytes
CRUMBS_PER_S = 500.0
"""Messages shorter than a frame's header: each costs as much as a frame. Who sends more is closed as well."""
MESSAGE_S = 1e-5
"""What a message costs besides what its bytes do: they may be one by one."""


class WebSocketTransport(asyncio.Transport):
    """A WebSocket as a `Connection` sees it: a transport of bytes."""

    def __init__(
        self, socket: web.WebSocketResponse, below: asyncio.Transport, connection: Connection, rounds: Rounds
    ) -> None:
        super().__init__()
        self._rounds = rounds
        self._share = Share()
        self._connection: Connection | None = connection
        """None when it has ended: two that know each other are kept until Python looks for circles."""
        self._socket = socket
        self._below = below
        self._encrypts = bool(below.get_extra_info("sslcontext"))
        """Then each piece would be encrypted for itself."""
        self._closing: asyncio.Task[bool] | None = None
        self._aborted = False
        self._lost = False
        """Whether what is below has ended, and what had come before is still given to the connection."""
        self._space: memoryview | None = None
        self._filled = 0
        """How much of it."""
        self._may_read = asyncio.Event()
        self._may_read.set()
        self._spare = Credit(PINGS_PER_S, time.monotonic())
        self._crumbs = Credit(CRUMBS_PER_S, time.monotonic())

    def begin(self) -> None:
        """The connection is there."""
        if self._connection is not None:
            self._connection.connection_made(self)

    def below_is_full(self) -> None:
        """Nothing more should be written for now."""
        if self._connection is not None:
            self._connection.pause_writing()

    def below_has_room(self) -> None:
        """It should again."""
        if self._connection is not None:
            self._connection.resume_writing()

    def below_is_lost(self) -> None:
        """It has ended: what came before counts, and is no more than aiohttp keeps. `lost` comes behind that."""
        self._lost = True
        self._may_read.set()

    def lost(self, exc: Exception | None) -> None:
        """It has ended, and nothing more comes."""
        if self._connection is not None:
            connection, self._connection = self._connection, None
            self._may_read.set()
            connection.connection_lost(exc)

    async def read(self) -> None:
        """Give the connection what comes, until the end."""
        try:
            await self._read()
        finally:
            self._pass_on()

    async def _read(self) -> None:
        while self._connection is not None:
            await self._may_read.wait()
            message = await AtOnce(self._socket.receive(), self._pass_on)
            if message.type is not WSMsgType.BINARY:
                self._pass_on()
            if (read := self._connection) is None:
                return
            if turn_s := self._rounds.spend(read.host, self._share, MESSAGE_S):
                self._pass_on()  # meanwhile others have the place where it was put
                await self._rounds.turn(read.host, self._share, turn_s)
            if message.type is WSMsgType.BINARY:
                if not message.data and not self._spares():
                    return
                if len(message.data) < CRUMB_BYTES and not self._takes_crumb():
                    return
                await self._feed(message.data)
            elif message.type in (WSMsgType.PING, WSMsgType.PONG):
                if not self._spares():
                    return
                if message.type is WSMsgType.PING:
                    with suppress(ConnectionError):
                        await self._socket.pong(message.data)
            elif message.type is WSMsgType.TEXT:
                await self._end(WSCloseCode.UNSUPPORTED_DATA, "it sends text, which nothing here understands")
                return
            elif message.type is WSMsgType.ERROR:
                self._complain("bad_websocket", f"what it sends is no WebSocket: {message.data}")
                return
            else:  # closed, by us or by the other end
                return

    async def _feed(self, data: bytes) -> None:
        """Put what a message carries where the connection's bytes belong: it looks at them when the next message has
        not come yet, so that frames that came together go on together."""
        view = memoryview(data)
        while len(view) and self._connection is not None and self._gives:
            if not self._may_read.is_set():
                self._pass_on()
                await self._may_read.wait()
                continue
            if self._space is None:
                self._space = self._connection.get_buffer(-1)
            size = min(len(self._space) - self._filled, len(view))
            self._space[self._filled : self._filled + size] = view[:size]
            self._filled += size
            view = view[size:]
            if self._filled == len(self._space):
                self._pass_on()

    def _pass_on(self) -> None:
        """Let the connection look at what was put there."""
        filled, self._filled = self._filled, 0
        self._space = None  # a view that is kept would keep a frame from growing
        if filled and self._connection is not None and self._gives:
            self._connection.handle(filled, time.monotonic())

    @property
    def _gives(self) -> bool:
        """Whether what comes still counts: also behind the other end's, but not behind ours."""
        return self._closing is None and not self._aborted

    def _spares(self) -> bool:
        """Whether it has not sent too much that says nothing; who has is gone."""
        if self._spare.take(1, time.monotonic()):
            return True
        self._complain("too_many_pings", f"more than {PINGS_PER_S:g} pings or empty messages a second")
        self.abort()
        return False

    def _takes_crumb(self) -> bool:
        """Likewise of messages that are only a few bytes of a frame."""
        if self._crumbs.take(1, time.monotonic()):
            return True
        what = f"more than {CRUMBS_PER_S:g} messages a second that are shorter than a frame's header"
        self._complain("too_many_pings", what)
        self.abort()
        return False

    def _complain(self, name: str, problem: str) -> None:
        if self._connection is not None:
            self._connection.complain(name, problem)

    async def _end(self, code: WSCloseCode, why: str) -> None:
        self._complain("not_binary", why)
        with suppress(ConnectionError):
            await self._socket.close(code=code)

    # -- a transport ---------------------------------------------------------------------------------------------

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """As the transport below; ``websocket`` is true."""
        return True if name == "websocket" else self._below.get_extra_info(name, default)

    def set_protocol(self, protocol: asyncio.BaseProtocol) -> None:
        """What comes is another connection's from now on, or nobody's."""
        self._connection = protocol if isinstance(protocol, Connection) else None
        self._may_read.set()

    def is_closing(self) -> bool:
        return self._closing is not None or self._connection is None or self._below.is_closing()

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.writelines([data])

    def writelines(self, list_of_data: Any) -> None:
        """Whole WebSocket messages. aiohttp writes its own, which are pongs and the last one, whole as well."""
        if not self.is_closing():
            pieces = list(_messages(list_of_data))
            self._below.writelines(joined(pieces) if self._encrypts else pieces)

    def get_write_buffer_size(self) -> int:
        return self._below.get_write_buffer_size()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        self._below.set_write_buffer_limits(high, low)

    def pause_reading(self) -> None:
        if not self._lost:
            self._may_read.clear()

    def resume_reading(self) -> None:
        self._may_read.set()

    def close(self) -> None:
        """Say goodbye behind what was written."""
        if not self.is_closing():
            self._may_read.set()
            self._closing = asyncio.get_running_loop().create_task(self._socket.close(code=WSCloseCode.OK))

    def abort(self) -> None:
        self._aborted = True
        self._may_read.set()
        self._below.abort()


class AtOnce:
    """Awaits something, and does something else first if that is not there at once."""

    def __init__(self, coroutine: Coroutine[Any, Any, WSMessage], otherwise: Callable[[], None]) -> None:
        self._coroutine = coroutine
        self._otherwise = otherwise

    def __await__(self) -> Generator[Any, Any, WSMessage]:
        steps = self._coroutine.__await__()
        step: Callable[[], object] = partial(next, steps)
        otherwise: Callable[[], None] = self._otherwise
        while True:
            try:
                waits_for = step()
            except StopIteration as done:
                return cast(WSMessage, done.value)
            otherwise()
            try:
                yield waits_for
            except BaseException as error:  # noqa: BLE001 - the end of what it waited for, or that of its task
                step = partial(steps.throw, error)
            else:
                step = partial(next, steps)


Piece = bytes | bytearray | memoryview


def _messages(chunks: Sequence[Piece]) -> Iterator[Piece]:
    """Binary messages of at most MESSAGE_BYTES, each behind its header, as a server sends them: not masked."""
    pieces: list[Piece] = []
    size = 0
    for chunk in chunks:
        for begin in range(0, len(chunk), MESSAGE_BYTES):
            piece = chunk if len(chunk) <= MESSAGE_BYTES else memoryview(chunk)[begin : begin + MESSAGE_BYTES]
            if size + len(piece) > MESSAGE_BYTES:
                yield _header(size)
                yield from pieces
                pieces, size = [], 0
            pieces.append(piece)
            size += len(piece)
    if size:
        yield _header(size)
        yield from pieces


def _header(size: int) -> bytes:
    """Of a binary message that is one WebSocket frame (RFC 6455, 5.2)."""
    if size < 126:
        return struct.pack("!BB", 0x82, size)
    if size < 1 << 16:
        return struct.pack("!BBH", 0x82, 126, size)
    return struct.pack("!BBQ", 0x82, 127, size)
