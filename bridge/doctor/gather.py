"""Collect facts about a mesh from where this runs: every router endpoint by itself, then who is behind them.

Two sessions per endpoint, with the settings' own credentials: what one declares or sends, the other must see or hear,
or access rules forbid it, since Zenoh refuses in silence. Tokens that this declares end in a chunk that no reader of
ours takes for an agent's (`MARK`), and what it sends to an inbox is empty, which agents ignore: nobody notices.
"""

from __future__ import annotations

import asyncio
import platform
import time
from collections.abc import Callable
from contextlib import AsyncExitStack, suppress
from typing import Any

import msgspec
from msgspec import structs

from bridge.principal import Principal
from bridge.settings import Settings
from macs_zenoh.errors import ConfigError, Unreachable
from macs_zenoh.mesh import Mesh, configuration
from macs_zenoh.protocol import endpoints, keyexpr
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import LEASE, NAME, PING, PRESENCE
from macs_zenoh.protocol.limits import ROUTER_BYTES
from macs_zenoh.protocol.rmw_zenoh.keyexpr import BadToken, Node, every_token, parse_token
from macs_zenoh.protocol.routers import Router, router_of

from . import transport
from .facts import Endpoint, Facts, Own, Program, RouterInfo, Session
from .measure import PINGS, Measurements
from .place import SETTLE_S, Place, tokens, until
from .rights import Trial

MAX_PINGED = 64
"""Programs that are pinged."""
MAX_ECHOED = 16
"""Of those, how many get echoes."""
HOPELESS_S = 1.0
"""How long Zenoh may try where TLS has failed already: what Python's TLS refuses, Zenoh's might take."""
JUDGED = (
    "mode",
    "scouting/multicast/enabled",
    "transport/shared_memory/enabled",
    "transport/link/tx/lease",
    "transport/link/tx/queue/size",
    "transport/link/tx/queue/congestion_control",
    "transport/link/tls/enable_mtls",
    "transport/link/tls/connect_certificate",
)
"""The lines of Zenoh's configuration that are worth judging."""

OnProgress = Callable[[str], None]


class Probe:
    """One look at a mesh. ``timeout_s`` bounds each single step."""

    def __init__(
        self,
        settings: Settings,
        *,
        principal: Principal,
        timeout_s: float,
        quick: bool,
        versions: tuple[str, str],
        on_progress: OnProgress = lambda text: None,
    ) -> None:
        """``versions``: of macs-zenoh and of the wheel. ``quick`` leaves out the echoes that measure throughput."""
        self._mesh = settings.mesh
        self._principal = principal
        self._timeout_s = timeout_s
        self._quick = quick
        self._say = on_progress
        self._stack = AsyncExitStack()
        self._trial = Trial(principal, timeout_s)
        self._measurements = Measurements(timeout_s)
        zenoh = configuration(settings.mesh)
        self._tls: dict[str, Any] = endpoints.value_at(zenoh, "transport/link/tls") or {}
        self._endpoints = list(dict.fromkeys(endpoints.configured(zenoh)))
        self._own = Own(
            macs=versions[0],
            zenoh=versions[1],
            python=platform.python_version(),
            who=str(principal),
            namespace=zenoh.get("namespace") or "",
            id_slots=settings.mesh.id_slots,
            group_slots=settings.mesh.group_slots,
            zenoh_settings={path: endpoints.value_at(zenoh, path) for path in JUDGED},
            certificates=transport.certificates(self._tls),
        )

    async def run(self) -> Facts:
        """Look at everything."""
        routers = [Endpoint(endpoint=endpoint) for endpoint in self._endpoints]
        async with self._stack:
            self._say("routers: " + ", ".join(self._endpoints))
            entered = await asyncio.gather(*(self._enter(endpoint) for endpoint in routers))
            places = [place for place in entered if place is not None]
            self._say("who is there, and what these settings may do")
            await asyncio.gather(*(self._survey(place) for place in places))
            await self._meet(places)
            await self._compare(places)
            for place in places:
                self._say(f"the way to {place.facts.endpoint}")
                await self._measure(place)
            programs = _programs(routers)
            if places:
                await self._visit(places[0], programs[:MAX_PINGED])
        return Facts(
            at_s=time.time(),
            own=self._own,
            endpoints=routers,
            programs=programs,
            unpinged=max(0, len(programs) - MAX_PINGED),
            probe_bytes=self._measurements.bytes,
        )

    # -- into a router -------------------------------------------------------------------------------------------

    async def _enter(self, facts: Endpoint) -> Place | None:
        """TCP, TLS, Zenoh: each step only says why the next cannot work."""
        protocol = endpoints.protocol_of(facts.endpoint)
        where = endpoints.address_of(facts.endpoint)
        if where is not None and protocol in ("tcp", "tls", "ws"):
            facts.reach, facts.reach_detail = await asyncio.to_thread(transport.reach, *where, self._timeout_s)
        if facts.reach not in ("ok", "untried"):
            return None
        if where is not None and protocol == "tls":
            settings = endpoints.tls_settings(facts.endpoint, self._tls)
            facts.tls = await asyncio.to_thread(transport.tls, *where, settings, self._timeout_s)
        hopeless = facts.tls is not None and facts.tls.problem
        timeout_s = min(HOPELESS_S, self._timeout_s) if hopeless else self._timeout_s
        try:
            first = await self._open(facts.endpoint, timeout_s)
            second = await self._open(facts.endpoint, timeout_s)
            everywhere = first
            if self._own.namespace:
                everywhere = await self._open(facts.endpoint, timeout_s, "namespace:null")
        except (Unreachable, ConfigError) as error:  # the second: a file of ours, see `transport`
            facts.problem = error.why if isinstance(error, Unreachable) else str(error)
            if where is not None and protocol == "tcp":
                facts.speaker = await asyncio.to_thread(transport.answers, *where, min(1.0, self._timeout_s))
                if facts.speaker == "gateway":
                    facts.router_beside = await asyncio.to_thread(transport.router_beside, where.host, self._timeout_s)
                facts.speaks_tls = await asyncio.to_thread(transport.speaks_tls, *where, min(1.0, self._timeout_s))
            return None
        facts.router = (first.routers or [""])[0]
        return Place(facts, first, second, everywhere)

    async def _open(self, endpoint: str, timeout_s: float, *overrides: str) -> Mesh:
        settings = structs.replace(
            self._mesh,
            mode="client",
            listen=[],
            namespace=None,
            overrides=[
                *self._mesh.overrides,
                'mode:"client"',
                "listen/endpoints:[]",
                "scouting/multicast/enabled:false",
                f"connect/endpoints:{msgspec.json.encode([endpoint]).decode()}",
                f"namespace:{msgspec.json.encode(self._own.namespace or None).decode()}",
                *overrides,
            ],
        )
        mesh = await Mesh.open_once(settings, timeout_s=timeout_s)
        await self._stack.enter_async_context(mesh)
        await until(lambda: mesh.linked, timeout_s)
        return mesh

    # -- what is there, and what may be done ---------------------------------------------------------------------

    async def _survey(self, place: Place) -> None:
        """The router's own account, who is there, and our rights."""
        facts, first, second = place.facts, place.first, place.second
        place.kept.append(second.answer_pings())
        for _ in range(PINGS):
            await self._measurements.round_trip(first, PING.of(zid=first.zid), facts.path)
        place.waited_s = SETTLE_S + 4 * max(facts.path.round_trips_ms, default=0.0) / 1000
        facts.routers = await self._ask_router(place.everywhere, facts.router)
        facts.leases = await tokens(first, LEASE.every(), self._timeout_s)
        facts.names = await tokens(first, NAME.every(), self._timeout_s)
        facts.elsewhere = await self._elsewhere(place.everywhere)
        facts.ros_nodes = await self._ros_nodes(place.everywhere)
        facts.rights = await self._trial.rights(place)
        facts.presence = await tokens(first, PRESENCE.every(), self._timeout_s)

    async def _elsewhere(self, mesh: Mesh) -> list[str]:
        found = await tokens(mesh, keyexpr.everywhere(PRESENCE), self._timeout_s)
        return [key for key in found if keyexpr.namespace_of(PRESENCE, key) != self._own.namespace]

    async def _ros_nodes(self, mesh: Mesh) -> list[str]:
        """By their tokens: asking their keys anything ends such nodes."""
        found = set()
        for token in await tokens(mesh, every_token(), self._timeout_s):
            with suppress(BadToken):
                node = parse_token(token)
                if isinstance(node, Node):
                    found.add(node.full_name)
        return sorted(found)

    async def _ask_router(self, mesh: Mesh, router: str) -> list[RouterInfo]:
        """What the admin space tells of all routers; of the one at this endpoint also with whom it is linked."""
        found = []
        for _, answer in await mesh.ask_all(keyexpr.ROUTERS, timeout_s=self._timeout_s):
            if (told := router_of(answer)) is not None:
                found.append(_router_info(told))
        graphs = await mesh.ask_all(keyexpr.router_links(router), timeout_s=self._timeout_s)
        drawn = [graph.decode(errors="replace") for _, graph in graphs if len(graph) <= ROUTER_BYTES]
        linked = sorted({part for graph in drawn for part in graph.split('"') if _is_zid(part)})
        for info in found:
            if info.zid == router:
                info.routers = linked
        return sorted(found, key=lambda info: info.zid)

    async def _meet(self, places: list[Place]) -> None:
        """Which endpoints' sessions see the tokens of which."""
        wait_s = max((place.waited_s for place in places), default=0.0)
        for place in places:
            for other in places:
                if other is place or not other.facts.rights.seen or not place.facts.rights.seen:
                    continue
                if await self._trial.shows_up(place.first, PRESENCE.every(), other.mark, wait_s):
                    place.facts.meets.append(other.facts.endpoint)

    async def _compare(self, places: list[Place]) -> None:
        """What an endpoint does not show of what others do that it meets. Who just comes or leaves does not count."""
        suspected = _missing(places, [place.facts.presence for place in places])
        if not any(suspected):
            return
        await asyncio.sleep(max(place.waited_s for place in places))
        shown = await asyncio.gather(*(tokens(place.first, PRESENCE.every(), self._timeout_s) for place in places))
        for place, before, now in zip(places, suspected, _missing(places, shown), strict=True):
            place.facts.misses = sorted(before & now)

    # -- measurements --------------------------------------------------------------------------------------------

    async def _measure(self, place: Place) -> None:
        if place.facts.rights.pings:
            place.facts.path.clock = await self._measurements.router_clock(place)
            place.facts.drops_commands = await self._measurements.drops_commands(place)
            if not self._quick:
                await self._measurements.echo(place.first, place.second.zid, place.facts.path)

    async def _visit(self, place: Place, programs: list[Program]) -> None:
        """Ping everybody, one after the other: side by side they would measure each other."""
        for number, program in enumerate(programs):
            self._say(f"{', '.join(program.agents[:3]) or program.zid} ({number + 1} of {len(programs)})")
            if place.facts.rights.pings:
                await self._measurements.ping(place.first, program)
            if program.pong is not None and not self._quick and number < MAX_ECHOED:
                await self._measurements.echo(place.first, program.zid, program.path)
            if self._principal.calls and program.agents and not program.blocks:
                program.called = await self._trial.call(place.first, program.agents[0])


def _is_zid(text: str) -> bool:
    return bool(text) and set(text) <= set("0123456789abcdef")


def _router_info(told: Router) -> RouterInfo:
    sessions = [
        Session(
            zid=session.peer,
            whatami=session.whatami,
            shared_memory=bool(session.shm),
            address=session.address,
        )
        for session in told.sessions
    ]
    return RouterInfo(zid=told.zid, version=told.version, sessions=sessions)


def _programs(endpoints: list[Endpoint]) -> list[Program]:
    """Everybody with presence or a lease, by session."""
    found: dict[str, Program] = {}

    def of(zid: str) -> Program:
        return found.setdefault(zid, Program(zid=zid, agents=[]))

    for key in dict.fromkeys(key for endpoint in endpoints for key in endpoint.presence):
        if agent := AgentInfo.parse(key):
            of(agent.zid).agents.append(f"{agent.type_name}/{agent.id}")
    for key in dict.fromkeys(key for endpoint in endpoints for key in endpoint.leases):
        if fields := LEASE.parse(key):
            of(fields.zid).blocks.append(fields.block)
    return list(found.values())


def _missing(places: list[Place], shown: list[list[str]]) -> list[set[str]]:
    """For each endpoint what it does not show of what those of other routers show that it meets."""
    missing = []
    for place, own in zip(places, shown, strict=True):
        there: set[str] = set()
        for other, keys in zip(places, shown, strict=True):
            if other.facts.endpoint in place.facts.meets and other.facts.router != place.facts.router:
                there.update(keys)
        missing.append(there.difference(own))
    return missing
