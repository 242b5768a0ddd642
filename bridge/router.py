"""A Zenoh router that notices when the link with another one is back and carries nothing, and starts again."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Sequence

from bridge.metrics.endpoint import watched_at
from bridge.metrics.families import Family, by_type
from bridge.metrics.watched import Watched
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh, configuration
from macs_zenoh.protocol import endpoints, keyexpr
from macs_zenoh.protocol.addresses import is_local

log = logging.getLogger("macs.router")

KEPT_IN = "-l tcp/127.0.0.1:7447 keeps it to this machine, `macs security generate` says who may what"
"""What to do about an endpoint that is `open_to_anybody`."""

SETTLE_S = 1.0
"""How long after a link is back all must be known that is behind it."""
ANSWER_S = 2.0
FORGOTTEN_S = 0.3
"""How long a router is away that starts again: other routers have to notice."""
AGAIN_S = 1.0


def open_to_anybody(settings: MeshSettings) -> list[str]:
    """The endpoints that others than this machine reach, and where nobody has to show who he is."""
    zenoh = configuration(settings)
    passwords = endpoints.value_at(zenoh, "transport/auth/usrpwd/dictionary_file")
    if passwords or endpoints.value_at(zenoh, "access_control/enabled"):
        return []
    found = []
    for endpoint in endpoints.configured(zenoh, "listen"):
        protocol, where = endpoints.protocol_of(endpoint), endpoints.address_of(endpoint)
        common = endpoints.value_at(zenoh, "transport/link/tls") or {}
        mutual = endpoints.tls_settings(endpoint, common).get("enable_mtls") in (True, "true")
        proven = protocol in ("tls", "quic") and mutual
        if where is not None and not is_local(where.host) and not proven:
            found.append(endpoint)
    return found


async def serve(settings: MeshSettings, *, on_ready: Callable[[], None], metrics: str | None = None) -> None:
    """Be a router until cancelled. At ``metrics``, HOST:PORT, it tells who watches it. Raises what `Mesh.open` raises,
    at the start."""
    now: list[Mesh] = []
    async with watched_at(metrics, Watched("router", lambda: now[-1] if now else None, figures=lambda: _figures(now))):
        await _serve(settings, now, on_ready)


def _figures(now: Sequence[Mesh]) -> Iterator[Family]:
    for mesh in now:
        yield by_type("macs_sessions", "sessions with this router", mesh.neighbours.values())


async def _serve(settings: MeshSettings, now: list[Mesh], on_ready: Callable[[], None]) -> None:
    """`serve`; ``now`` has the router's session as long as there is one."""
    known: set[str] = set()
    mesh, ready = await Mesh.open(settings), False
    while True:
        async with mesh:
            now[:] = [mesh]
            if not ready:
                on_ready()
                ready = True
            router = await _dead_link(mesh, known)
            log.warning("the link with router %s is back and carries nothing; starting again", router[:8])
            now.clear()
        await asyncio.sleep(FORGOTTEN_S)
        mesh = await _opened_again(settings)


async def _opened_again(settings: MeshSettings) -> Mesh:
    """The router once more. What has changed meanwhile in its files must not end what was running."""
    problem = ""
    while True:
        try:
            return await Mesh.open(settings)
        except MacsError as error:
            if str(error) != problem:
                problem = str(error)
                log.error("cannot start again yet: %s", problem)
            await asyncio.sleep(AGAIN_S)


async def _dead_link(mesh: Mesh, known: set[str]) -> str:
    """Wait until a link with another router is back and carries nothing; the router's Zenoh id.

    Zenoh 1.10.2 works out its routes at most every 100 ms. A link that is lost and back in between is taken for one
    that was never lost: nothing that exists is declared on it again, for as long as it lasts.

    ``known`` are routers that have answered before: one that never does may not be allowed to.
    """
    dead: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    checks: dict[str, asyncio.Task[None]] = {}

    async def check(router: str) -> None:
        for _ in range(2):
            await asyncio.sleep(SETTLE_S)
            began = time.monotonic()
            if await mesh.ask_all(keyexpr.router(router), timeout_s=ANSWER_S):
                known.add(router)
                return
            if time.monotonic() - began > ANSWER_S / 2:
                return  # it is only slow: where nothing leads to it, Zenoh says so at once
        if router in known and router in mesh.routers and not dead.done():
            known.discard(router)  # should it be something else, once is enough
            dead.set_result(router)

    def look(router: str) -> None:
        if router in checks:
            checks[router].cancel()  # the link is newer than that
        checks[router] = asyncio.create_task(check(router))

    mesh.on_router(look)
    for router in mesh.routers:  # those that were faster
        look(router)
    try:
        return await dead
    finally:
        for task in checks.values():
            task.cancel()
