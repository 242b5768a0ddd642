"""What a gateway's web port answers besides WebSockets: pages, files and figures, each added by a module of its own.

A module has a function that takes a `Site` and says which requests it answers::

    def add_metrics(site: Site) -> None:
        async def answer(request: web.Request, visitor: Grant) -> web.StreamResponse:
            return web.Response(text=written(site.gateway.drops))

        site.get("/metrics", answer)

and `gateway.pages` names it. Who asks has shown a valid token where one is wanted, in the header ``Authorization:
Bearer`` or as the cookie of a login; what the token permits is the visitor's `Grant`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

from aiohttp import web

from macs_zenoh.protocol.rights import OPEN, Grant

from .door import Door, Entrance

if TYPE_CHECKING:
    from . import Gateway

COOKIE = "macs_token"
WRONG = {"error": "a valid token is wanted here"}
"""Whatever was wrong with it."""

Answer = Callable[[web.Request, Grant], Awaitable[web.StreamResponse]]
AnswerAll = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Site:
    """The web port as a module sees it that adds requests to it. ``gateway`` is whose it is."""

    def __init__(
        self,
        gateway: Gateway,
        router: web.UrlDispatcher,
        entrance: Entrance,
        door: Door,
        host_of: Callable[[web.Request], str],
        goes_on: Callable[[web.Request], None],
    ) -> None:
        """``host_of`` tells the address that a request comes from; ``goes_on`` gives its answer more time."""
        self.gateway = gateway
        self._router = router
        self._entrance = entrance
        self._door = door
        self.host_of = host_of
        self.goes_on = goes_on
        """An answer that takes long has to say so at least every few seconds, or its connection is ended."""
        self._at_end: list[Callable[[], None]] = []

    def on_close(self, callback: Callable[[], None]) -> None:
        """Call this when the port ends."""
        self._at_end.append(callback)

    def close(self) -> None:
        """The port has ended."""
        for callback in self._at_end:
            callback()

    def get(self, path: str, answer: Answer) -> None:
        """Answer this path, written as for aiohttp, to who shows a valid token where one is wanted."""
        self._router.add_get(path, self._judged(answer))

    def post(self, path: str, answer: Answer) -> None:
        """The same for what changes something. Pages from elsewhere were refused before, by their origin."""
        self._router.add_post(path, self._judged(answer))

    def _judged(self, answer: Answer) -> AnswerAll:
        async def judged(request: web.Request) -> web.StreamResponse:
            visitor = self.visitor(request)
            if visitor is None:
                self.refuse(request)
                return web.json_response(WRONG, status=401, headers={"WWW-Authenticate": "Bearer"})
            return await answer(request, visitor)

        return judged

    def get_for_all(self, path: str, answer: AnswerAll) -> None:
        """Answer this path to everybody whom the port lets in at all, as a page has to be that asks for the token."""
        self._router.add_get(path, answer)

    def refuse(self, request: web.Request) -> None:
        """Who asks is not let in: count it, and log it, if he has shown a token."""
        if _shown(request) is not None:
            self._door.refuse_request(self._entrance, self.host_of(request))

    def visitor(self, request: web.Request) -> Grant | None:
        """What who asks may do; None: a valid token is wanted, and none is shown."""
        shown = _shown(request)
        token = None if shown is None else self._door.find(shown)
        if token is not None:
            return Grant(token.name, token.rights)
        if self._entrance.wants_token(self.host_of(request)) or "Authorization" in request.headers:
            return None
        return OPEN  # a cookie that is left over from another time counts for nothing


def _shown(request: web.Request) -> str | None:
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    return request.cookies.get(COOKIE)
