"""The web port: HTTP for a login and for pairing, and WebSocket, whose binary messages are pieces of the byte stream.

aiohttp speaks HTTP and WebSocket. What it does not bound is bounded here: how long a request may take to come, how
many may be at it, and how many pings are answered. What is written goes past aiohttp, as whole WebSocket messages,
into the transport below it: a task for each message would cost more than the message.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import ssl
import struct
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine, Generator, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from bridge.settings import GatewaySettings
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.addresses import of_peer
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.origins import host_problem, origin_problem
from macs_zenoh.protocol.websocket import MESSAGE_BYTES, SUBPROTOCOL, TOKEN_SUBPROTOCOL, WEBSOCKET_PATH
from macs_zenoh.protocol.wire import MACS

from .admission import is_in, networks
from .connection import Connection
from .door import Door, Entrance
from .listener import Listener
from .shares import TURN_S, Rounds, Share
from .site import COOKIE, WRONG, Site, add_routes
from .writer import joined

if TYPE_CHECKING:
    from . import Gateway

log = logging.getLogger("macs.gateway")

REQUEST_S = 10.0
"""How long a request may take to come, and a connection may wait for its next one."""
BODY_BYTES = 4 << 10
HTTP_IN_ALL = 512
HTTP_PER_ADDRESS = 128
"""Connections that are no WebSocket, or not yet one."""
PIPELINED = 8
"""So many requests of one connection may wait to be answered; some releases of aiohttp know no limit."""
PINGS_PER_S = 10.0
"""Pings and empty messages; who sends more is closed."""
CRUMB_BYTES = MACS.header_bytes
CRUMBS_PER_S = 500.0
"""Messages shorter than a frame's header: each costs as much as a frame. Who sends more is closed as well."""
CLOSE_S = 2.0
MESSAGE_S = 1e-5
"""What a message costs besides what its bytes do: they may be one by one."""
LEAST_READ_BYTES = 4 << 10
MOST_READ_BYTES = 256 << 10
COOKIE_S = 30 * 24 * 3600

Answer = Callable[[web.Request], Awaitable[web.StreamResponse]]


class WebPort:
    """The HTTP server of a gateway, on sockets that somebody else has bound."""

    def __init__(
        self,
        settings: GatewaySettings,
        entrance: Entrance,
        door: Door,
        connect: Callable[[Entrance], Connection],
        drops: Losses,
        context: ssl.SSLContext | None,
        gateway: Gateway,
    ) -> None:
        self._settings = settings
        self._entrance = entrance
        self._door = door
        self._connect = connect
        self.drops = drops
        self._context = context
        self._allow = networks(settings.allow)
        own = socket.gethostname().lower()
        self._names = frozenset({*(name.lower() for name in settings.web_names), own, f"{own}.local"})
        self.rounds = gateway.rounds
        self._at_http: Counter[str] = Counter()
        self._listeners: list[Listener] = []
        self.scratch = memoryview(bytearray(MOST_READ_BYTES))
        """Sockets of one loop receive one after the other."""
        app = web.Application(client_max_size=BODY_BYTES, middlewares=[self._middle()])
        app.router.add_get(WEBSOCKET_PATH, self._websocket)
        app.router.add_post("/login", self._login)
        app.router.add_post("/pair", self._pair)
        self._site = Site(
            gateway,
            app.router,
            entrance,
            door,
            lambda request: _outer_of(request).host,
            lambda request: _outer_of(request).wait(),
        )
        add_routes(self._site)
        self._runner = web.AppRunner(
            app,
            handle_signals=False,
            access_log=None,
            logger=_HttpLog(drops),
            keepalive_timeout=REQUEST_S,
            shutdown_timeout=0.1,
        )

    async def open(self, sockets: Sequence[socket.socket]) -> None:
        """Listen. Raises OSError."""
        await self._runner.setup()
        for listening in sockets:
            self._listeners.append(
                Listener(listening, self._outer, self.drops, context=self._context, handshake_s=REQUEST_S)
            )

    def close(self) -> None:
        """Accept nobody any more."""
        for listener in self._listeners:
            listener.close()

    async def end(self) -> None:
        """After all connections have been closed: end what is left."""
        self._site.close()
        await self._runner.cleanup()

    # -- connections ---------------------------------------------------------------------------------------------

    def _outer(self) -> _Outer:
        server = self._runner.server
        assert server is not None
        return _Outer(cast("asyncio.Protocol", server()), self)

    def enter(self, host: str) -> bool:
        """Whether one more HTTP connection of this address is let in."""
        if self._allow and not is_in(host, self._allow):
            self.drops.once("address_not_allowed", "%s is refused: its address is not in gateway.allow", host)
            return False
        if self._at_http[host] >= HTTP_PER_ADDRESS or self._at_http.total() >= HTTP_IN_ALL:
            self.drops.once("too_many_requests", "%s is refused: %d web requests wait", host, self._at_http[host])
            return False
        self._at_http[host] += 1
        return True

    def leave(self, host: str) -> None:
        """One is no HTTP connection any more."""
        self._at_http[host] -= 1
        if self._at_http[host] <= 0:
            del self._at_http[host]

    # -- requests ------------------------------------------------------------------------------------------------

    def _middle(self) -> Any:
        @web.middleware
        async def middle(request: web.Request, handler: Answer) -> web.StreamResponse:
            outer = _outer_of(request)
            host = request.headers.get("Host", "")
            origin = request.headers.get("Origin")
            problem = host_problem(host, self._names) or origin_problem(origin, host, self._settings.web_origins)
            if problem is not None:
                self.drops.once("other_page", "%s: a web request is refused: %s", outer.host, problem)
                return web.json_response({"error": problem}, status=403)
            await self.rounds.turn(outer.host)  # one request, and then all else that is due
            try:
                response = await handler(request)
            finally:
                outer.wait()
            if not response.prepared:
                response.headers.setdefault("Cache-Control", "no-store")
                response.headers["X-Content-Type-Options"] = "nosniff"
                if origin in self._settings.web_origins:  # a listed page may use our modules, and read what is told
                    response.headers["Access-Control-Allow-Origin"] = str(origin)
            return response

        return middle

    async def _login(self, request: web.Request) -> web.StreamResponse:
        """A token for a cookie, which pages cannot read."""
        token = await _said(request, "token")
        if self._door.find(token) is None:
            return self._wrong(request)
        response = web.json_response({"ok": True})
        response.set_cookie(
            COOKIE,
            token or "",
            httponly=True,
            samesite="Strict",
            secure=self._context is not None,
            path="/",
            max_age=COOKIE_S,
        )
        return response

    async def _pair(self, request: web.Request) -> web.StreamResponse:
        """A code that somebody was shown for a token, once."""
        code = await _said(request, "code")
        token = await self._door.exchange(code) if code is not None else None
        if token is None:
            return self._wrong(request)
        return web.json_response({"token": token})

    def _wrong(self, request: web.Request) -> web.Response:
        self._door.refuse_request(self._entrance, _outer_of(request).host)
        return web.json_response(WRONG, status=401)

    async def _websocket(self, request: web.Request) -> web.StreamResponse:
        offered = [each.strip() for each in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
        shown = next((each[len(TOKEN_SUBPROTOCOL) :] for each in offered if each.startswith(TOKEN_SUBPROTOCOL)), None)
        if shown is None:
            shown = request.cookies.get(COOKIE)
            if self._door.find(shown) is None and not self._entrance.wants_token(_outer_of(request).host):
                shown = None  # left over from another time, and nobody asks for it
        if shown is not None and self._door.find(shown) is None:
            return self._wrong(request)
        socket = web.WebSocketResponse(
            protocols=(SUBPROTOCOL,), timeout=CLOSE_S, autoping=False, compress=False, max_msg_size=MESSAGE_BYTES + 1
        )
        if not socket.can_prepare(request):
            return web.json_response(
                {"error": "a WebSocket is wanted here"}, status=426, headers={"Upgrade": "websocket"}
            )
        await socket.prepare(request)
        outer = _outer_of(request)
        connection = self._connect(self._entrance)
        connection.shown_token = shown
        stream = WebSocketTransport(socket, outer.transport, connection, self.rounds)
        outer.upgraded(stream)
        stream.begin()
        try:
            await stream.read()
        finally:
            stream.lost(None)
        return socket


class _HttpLog(logging.Logger):
    """What aiohttp says: what a client did wrong is counted, the rest is for us to mend."""

    def __init__(self, drops: Losses) -> None:
        super().__init__("macs.gateway.web")
        self.parent = log
        self._drops = drops

    def handle(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        if isinstance(error, HttpProcessingError | ConnectionError):
            self._drops.once("bad_http", "%s (%s)", record.getMessage(), type(error).__name__)
        else:
            super().handle(record)


def _outer_of(request: web.Request) -> _Outer:
    transport = request.transport
    if transport is None:
        raise web.HTTPBadRequest  # it is gone
    return cast("_Outer", transport.get_protocol())


async def _said(request: web.Request, name: str) -> str | None:
    """A text in the JSON object that a request brings; None for whatever else it brings."""
    with suppress(ValueError, UnicodeDecodeError, RecursionError, web.HTTPRequestEntityTooLarge):
        body = json.loads(await request.read())
        if isinstance(body, dict) and isinstance(body.get(name), str):
            return str(body[name])
    return None


class _Outer(asyncio.BufferedProtocol):
    """What a socket of the web port talks to: aiohttp's protocol, within limits of time that it does not have, for a
    request and for what one read brings: thousands of tiny WebSocket frames are parsed at once otherwise."""

    def __init__(self, inner: asyncio.Protocol, port: WebPort) -> None:
        self._inner = inner
        self._port = port
        self.transport: asyncio.Transport
        self.host = "?"
        self._stream: WebSocketTransport | None = None
        self._counted = False
        self._timer: asyncio.TimerHandle | None = None
        self._read_bytes = LEAST_READ_BYTES
        self._share = Share()
        self._full = False
        """Whether it is not read from, since so many of its requests wait."""
        self._shared: _SharedTransport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        name = transport.get_extra_info("peername")
        self.host = of_peer(str(name[0])) if name else "?"
        if not self._port.enter(self.host):
            self.transport.abort()
            return
        self._counted = True
        self._shared = _SharedTransport(self.transport)
        self.wait()
        self._inner.connection_made(cast(asyncio.BaseTransport, self._shared))

    def get_buffer(self, sizehint: int) -> memoryview:
        most = LEAST_READ_BYTES if self._stream is None else self._read_bytes
        return self._port.scratch[:most]

    def buffer_updated(self, nbytes: int) -> None:
        if not self._counted and self._stream is None:
            return  # it was not let in
        began = time.monotonic()
        self._inner.data_received(bytes(self._port.scratch[:nbytes]))
        took_s = time.monotonic() - began
        if took_s > TURN_S:
            self._read_bytes = max(LEAST_READ_BYTES, self._read_bytes // 2)
        elif took_s < TURN_S / 2 and nbytes == self._read_bytes:
            self._read_bytes = min(len(self._port.scratch), 2 * self._read_bytes)
        if self._stream is None and not self._full and self._has_many():
            self._full = True
            self._shared.hold()
        rounds = self._port.rounds
        if (turn_s := rounds.spend(self.host, self._share, took_s)) and not self.transport.is_closing():
            self._shared.hold()
            rounds.enter(self.host, self._shared.let_go, turn_s)

    def eof_received(self) -> bool | None:
        return self._inner.eof_received() if self._counted or self._stream is not None else None

    def pause_writing(self) -> None:
        self._inner.pause_writing()
        if self._stream is not None:
            self._stream.below_is_full()

    def resume_writing(self) -> None:
        self._inner.resume_writing()
        if self._stream is not None:
            self._stream.below_has_room()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        entered = self._counted or self._stream is not None
        self._leave()
        if entered:
            self._inner.connection_lost(exc)
        if self._stream is not None:
            self._stream.lost(exc)

    def wait(self) -> None:
        """For a whole request and its answer, from now on."""
        self._stop_waiting()
        if self._full and not self._has_many():
            self._full = False
            self._shared.let_go()
        if self._stream is None and not self.transport.is_closing():
            self._timer = asyncio.get_running_loop().call_later(REQUEST_S, self._late)

    def upgraded(self, stream: WebSocketTransport) -> None:
        """From now on this is an agent's connection, which others count."""
        self._stream = stream
        self._stop_waiting()
        self._leave()
        if self._full:
            self._full = False
            self._shared.let_go()

    def _has_many(self) -> bool:
        return len(getattr(self._inner, "_messages", ())) > PIPELINED

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _leave(self) -> None:
        if self._counted:
            self._counted = False
            self._port.leave(self.host)

    def _late(self) -> None:
        self._timer = None
        self.transport.abort()


class _SharedTransport:
    """A transport whose reading two may pause: aiohttp, when much waits in its queues, and we."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._paused = False
        self._holds = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)

    def pause_reading(self) -> None:
        """aiohttp's."""
        self._set(paused=True, holds=self._holds)

    def resume_reading(self) -> None:
        """Likewise."""
        self._set(paused=False, holds=self._holds)

    def hold(self) -> None:
        """Ours, until as many `let_go` as `hold` were called."""
        self._set(paused=self._paused, holds=self._holds + 1)

    def let_go(self) -> None:
        """Likewise."""
        self._set(paused=self._paused, holds=self._holds - 1)

    def _set(self, *, paused: bool, holds: int) -> None:
        before, self._paused, self._holds = self._paused or self._holds > 0, paused, holds
        now = paused or holds > 0
        if now == before or self._transport.is_closing():
            return
        if now:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()


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

    def lost(self, exc: Exception | None) -> None:
        """It has ended."""
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
            message = await _AtOnce(self._socket.receive(), self._pass_on)
            if message.type is not WSMsgType.BINARY:
                self._pass_on()
            if (read := self._connection) is None:
                return
            if turn_s := self._rounds.spend(read.host, self._share, MESSAGE_S):
                self._pass_on()  # meanwhile others have the place where it was put
                await self._rounds.turn(read.host, turn_s)
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
        while len(view) and self._connection is not None and not self.is_closing():
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
        if filled and self._connection is not None and not self.is_closing():
            self._connection.buffer_updated(filled)

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
        self._may_read.clear()

    def resume_reading(self) -> None:
        self._may_read.set()

    def close(self) -> None:
        """Say goodbye behind what was written."""
        if not self.is_closing():
            self._may_read.set()
            self._closing = asyncio.get_running_loop().create_task(self._socket.close(code=WSCloseCode.OK))

    def abort(self) -> None:
        self._below.abort()


class _AtOnce:
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
