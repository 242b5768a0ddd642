"""The web port: HTTP for a login and for pairing, and the way to a WebSocket (`websocket`).

aiohttp speaks HTTP. What it does not bound is bounded here: how long a request may take to come, and how many may be
at it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import ssl
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from bridge.settings import GatewaySettings
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.addresses import of_peer
from macs_zenoh.protocol.origins import host_problem, origin_problem
from macs_zenoh.protocol.websocket import MESSAGE_BYTES, SUBPROTOCOL, TOKEN_SUBPROTOCOL, WEBSOCKET_PATH

from .admission import is_in, networks
from .connection import Connection
from .door import Door, Entrance
from .listener import Listener
from .pages import add_routes
from .shares import LATE_READ_BYTES, TURN_S, Share
from .site import COOKIE, WRONG, Site
from .websocket import WebSocketTransport

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
CLOSE_S = 2.0
LEAST_READ_BYTES = 1 << 10
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
            await self.rounds.turn(outer.host, None)  # one request, and then all else that is due
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
        self._asked_at = 0.0
        """When room for bytes was asked for last."""
        self._is_late = False
        """Whether what is read comes late in a long round."""
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
        self._asked_at = time.monotonic()
        usual = LEAST_READ_BYTES if self._stream is None else self._read_bytes
        rounds = self._port.rounds
        self._is_late = rounds.long
        return self._port.scratch[: rounds.most_bytes(self.host, self._share, usual)]

    def buffer_updated(self, nbytes: int) -> None:
        if not self._counted and self._stream is None:
            return  # it was not let in
        self._inner.data_received(bytes(self._port.scratch[:nbytes]))
        took_s = time.monotonic() - self._asked_at  # with what it took to decrypt
        if took_s > TURN_S:
            self._read_bytes = max(LEAST_READ_BYTES, self._read_bytes // 2)
        elif took_s < TURN_S / 2 and nbytes == self._read_bytes:
            self._read_bytes = min(len(self._port.scratch), 2 * self._read_bytes)
        if self._stream is None and not self._full and self._has_many():
            self._full = True
            self._shared.hold()
        rounds = self._port.rounds
        turn_s = rounds.spend(self.host, self._share, took_s)
        if self.transport.is_closing():
            return
        if turn_s:
            self._shared.hold()
            rounds.enter(self.host, self._share, self._shared.let_go, turn_s)
        elif self._is_late and nbytes >= LATE_READ_BYTES:
            self._shared.hold()
            asyncio.get_running_loop().call_soon(self._shared.let_go)

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
            self._stream.below_is_lost()

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
