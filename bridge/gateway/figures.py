"""What a gateway tells who watches it: figures, whether it is ready, and why not."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from time import monotonic
from typing import TYPE_CHECKING, Any

from aiohttp import web

from bridge.metrics.answers import Answered, Answers
from bridge.metrics.families import Family, by_type, counter, gauge
from bridge.metrics.watched import Watched
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.protocol.rights import Grant

from .site import Site

if TYPE_CHECKING:
    from .server import Gateway


def watched(gateway: Gateway) -> Watched:
    """A gateway as who watches it sees it."""
    return watched_now(lambda: gateway)


def watched_now(current: Callable[[], Gateway | None]) -> Watched:
    """The same for a program whose gateway may be another one later; None: there is none in this moment."""

    def of(read: Callable[[Gateway], Any], otherwise: Any) -> Callable[[], Any]:
        def read_now() -> Any:
            gateway = current()
            return otherwise if gateway is None else read(gateway)

        return read_now

    return Watched(
        "gateway",
        of(lambda gateway: gateway.mesh, None),
        figures=of(_figures, ()),
        lost=of(lambda gateway: {"gateway": gateway.drops, "connections": _of_connections(gateway)}, {}),
        problems=of(lambda gateway: [] if gateway.port else ["it does not listen yet"], []),
        facts=of(_facts, {}),
        directory=of(lambda gateway: gateway.directory, None),
    )


def _of_connections(gateway: Gateway) -> Mapping[str, int]:
    """What was lost for those who are connected now; of the others the gateway has it."""
    lost: Counter[str] = Counter()
    for connection in gateway.agents.connections():
        lost.update(connection.all_drops())
    return lost


def _figures(gateway: Gateway) -> Iterator[Family]:
    online = list(gateway.agents.online())
    now = monotonic()
    yield by_type("macs_own_agents", "agents of this gateway", (type_name(each.peer.agent_type) for each in online))
    yield gauge("macs_connections", "connections, with those that have not said who they are").add(len(gateway.agents))
    yield gauge("macs_away_agents", "agents of which nothing was heard for 10 s").add(
        sum(each.is_away(now) for each in online)
    )
    yield gauge("macs_slow_agents", "agents that read more slowly than is sent to them").add(
        sum(each.full for each in online)
    )
    for name, what, amount in gateway.amounts():
        yield gauge(name, what).add(amount)
    received, sent = gateway.carried()
    yield (
        counter("macs_agent_bytes", "bytes of agents' sockets")
        .add(received, direction="in")
        .add(sent, direction="out")
    )


def _facts(gateway: Gateway) -> dict[str, Any]:
    return {
        "address": gateway.address,
        "blocks": gateway.blocks,
        "agents": dict(Counter(type_name(each.peer.agent_type) for each in gateway.agents.online())),
        "mesh_agents": len(gateway.directory),
        "amounts": {name: amount for name, _, amount in gateway.amounts()},
    }


def add_figures(site: Site) -> None:
    """Answer who watches, at the web port: figures and diagnostics to who shows a token where one is wanted, to all
    others whether the gateway lives and is ready."""
    answers = Answers(watched(site.gateway))

    def written(said: Answered) -> web.Response:
        return web.Response(status=said.status, body=said.body, headers={"Content-Type": said.media_type})

    async def for_visitors(request: web.Request, visitor: Grant) -> web.StreamResponse:
        return written(answers.fresh(request.path, request.headers.get("Accept", ""), monotonic()))

    async def for_all(request: web.Request) -> web.StreamResponse:
        return written(answers.answer(request.path))

    for path in ("/metrics", "/diagnostics"):
        site.get(path, for_visitors)
    for path in ("/healthz", "/readyz"):
        site.get_for_all(path, for_all)
