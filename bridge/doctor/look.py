"""Collect facts about a mesh from where this runs: every router endpoint by itself, then who is behind them.

Two sessions per endpoint, with the settings' own credentials: what one declares or sends, the other must see or hear,
or access rules forbid it, since Zenoh refuses in silence. Tokens that this declares end in a chunk that no reader of
ours takes for an agent's (`_MARK`), and what it sends to an inbox is empty, which agents ignore: nobody notices.
"""

from __future__ import annotations

import asyncio
import platform
import time
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from typing import Any

import msgspec
from msgspec import structs

from bridge.principal import Principal
from macs_zenoh.config import Settings
from macs_zenoh.errors import CallTimeout, ConfigError, MacsError, Refused, Unreachable, WireError
from macs_zenoh.mesh import Mesh, Subscription, Traffic, configuration
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.addresses import of_endpoint
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import (
    LEASE,
    NAME,
    PING,
    PRESENCE,
    UNICAST,
    block_of,
    type_name,
)
from macs_zenoh.protocol.messages import ROS, Metadata
from macs_zenoh.protocol.routing import call, inbox
from macs_zenoh.protocol.wire import PROBE

from . import below
from .facts import Clock, Echo, Endpoint, Facts, Own, Program, Rights, RouterInfo, Session, Way

_MARK = "%64octor-"
"""An escape that nothing of ours writes (``d`` needs none): access rules see one chunk, readers of keys see nobody."""

PINGS = 5
ECHO_BYTES = (4 << 10, 64 << 10, 256 << 10, 1 << 20)
"""One after the other, while the last one took at most `ECHO_S` longer than the first: a slow link gets little."""
ECHO_S = 0.25
CALLED = ("ping", "status")
"""Calls without effect: every agent serves the first, robots the second, which access rules may allow alone."""
MAX_PINGED = 64
"""Programs that are pinged."""
MAX_ECHOED = 16
"""Of those, how many get echoes."""
SETTLE_S = 0.5
"""How long something that was declared may take until others see it, apart from the way there."""
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


@dataclass
class _Place:
    """A router endpoint while it is examined: its facts, and the sessions through it."""

    facts: Endpoint
    first: Mesh
    second: Mesh
    everywhere: Mesh
    """Without the settings' namespace."""
    mark: str = ""
    waited_s: float = SETTLE_S
    kept: list[Subscription] = field(default_factory=list)


class Examination:
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
        self._bytes = 0
        zenoh = configuration(settings.mesh)
        self._tls: dict[str, Any] = at(zenoh, "transport/link/tls") or {}
        self._endpoints = list(dict.fromkeys(endpoints_of(zenoh)))
        self._own = Own(
            macs=versions[0],
            zenoh=versions[1],
            python=platform.python_version(),
            who=str(principal),
            namespace=zenoh.get("namespace") or "",
            id_slots=settings.mesh.id_slots,
            group_slots=settings.mesh.group_slots,
            zenoh_settings={path: at(zenoh, path) for path in JUDGED},
            certificates=below.certificates(self._tls),
        )

    async def run(self) -> Facts:
        """Look at everything."""
        endpoints = [Endpoint(endpoint=endpoint) for endpoint in self._endpoints]
        async with self._stack:
            self._say("routers: " + ", ".join(self._endpoints))
            entered = await asyncio.gather(*(self._enter(endpoint) for endpoint in endpoints))
            places = [place for place in entered if place is not None]
            self._say("who is there, and what these settings may do")
            await asyncio.gather(*(self._survey(place) for place in places))
            await self._meet(places)
            await self._compare(places)
            for place in places:
                self._say(f"the way to {place.facts.endpoint}")
                await self._measure(place)
            programs = _programs(endpoints)
            if places:
                await self._visit(places[0], programs[:MAX_PINGED])
        return Facts(
            at_s=time.time(),
            own=self._own,
            endpoints=endpoints,
            programs=programs,
            unpinged=max(0, len(programs) - MAX_PINGED),
            probe_bytes=self._bytes,
        )

    # -- into a router -------------------------------------------------------------------------------------------

    async def _enter(self, facts: Endpoint) -> _Place | None:
        """TCP, TLS, Zenoh: each step only says why the next cannot work."""
        protocol = facts.endpoint.partition("/")[0]
        where = of_endpoint(facts.endpoint)
        if where is not None and protocol in ("tcp", "tls", "ws"):
            facts.reach, facts.reach_detail = await asyncio.to_thread(below.reach, *where, self._timeout_s)
        if facts.reach not in ("ok", "untried"):
            return None
        if where is not None and protocol == "tls":
            settings = below.tls_settings(facts.endpoint, self._tls)
            facts.tls = await asyncio.to_thread(below.tls, *where, settings, self._timeout_s)
        hopeless = facts.tls is not None and facts.tls.problem
        timeout_s = min(HOPELESS_S, self._timeout_s) if hopeless else self._timeout_s
        try:
            first = await self._open(facts.endpoint, timeout_s)
            second = await self._open(facts.endpoint, timeout_s)
            everywhere = first
            if self._own.namespace:
                everywhere = await self._open(facts.endpoint, timeout_s, "namespace:null")
        except (Unreachable, ConfigError) as error:  # the second: a file of ours, see `below`
            facts.problem = error.why if isinstance(error, Unreachable) else str(error)
            if where is not None and protocol == "tcp":
                facts.speaker = await asyncio.to_thread(below.answers, *where, min(1.0, self._timeout_s))
                if facts.speaker == "gateway":
                    facts.router_beside = await asyncio.to_thread(below.router_beside, where.host, self._timeout_s)
                facts.speaks_tls = await asyncio.to_thread(below.speaks_tls, *where, min(1.0, self._timeout_s))
            return None
        facts.router = (first.routers or [""])[0]
        return _Place(facts, first, second, everywhere)

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
        await _until(lambda: mesh.linked, timeout_s)
        return mesh

    # -- what is there, and what may be done ---------------------------------------------------------------------

    async def _survey(self, place: _Place) -> None:
        """The router's own account, who is there, and our rights."""
        facts, first, second = place.facts, place.first, place.second
        place.kept.append(second.answer_pings())
        for _ in range(PINGS):
            await self._round_trip(first, PING.of(zid=first.zid), facts.way)
        place.waited_s = SETTLE_S + 4 * max(facts.way.round_trips_ms, default=0.0) / 1000
        facts.routers = await self._ask_router(place.everywhere, facts.router)
        facts.leases = await self._tokens(first, LEASE.every())
        facts.names = await self._tokens(first, NAME.every())
        facts.elsewhere = await self._elsewhere(place.everywhere)
        facts.rights = await self._try_rights(place)
        facts.presence = await self._tokens(first, PRESENCE.every())

    async def _tokens(self, mesh: Mesh, key: str) -> list[str]:
        """Each token once, without our own."""
        return [
            found for found in dict.fromkeys(await mesh.tokens(key, timeout_s=self._timeout_s)) if _MARK not in found
        ]

    async def _elsewhere(self, mesh: Mesh) -> list[str]:
        own = f"{self._own.namespace}/" if self._own.namespace else ""
        found = await self._tokens(mesh, "**/" + PRESENCE.every())
        return [key for key in found if PRESENCE.parse(key.removeprefix(own) if key.startswith(own) else "") is None]

    async def _ask_router(self, mesh: Mesh, router: str) -> list[RouterInfo]:
        """What the admin space tells of all routers; of the one at this endpoint also with whom it is linked."""
        found = []
        for _, answer in await mesh.ask_all("@/*/router", timeout_s=self._timeout_s):
            try:
                found.append(_router_info(msgspec.json.decode(answer)))
            except (msgspec.DecodeError, KeyError, TypeError):
                continue  # a router of another kind
        graphs = await mesh.ask_all(f"@/{router}/router/linkstate/north", timeout_s=self._timeout_s)
        linked = sorted({part for _, graph in graphs for part in graph.decode().split('"') if _is_zid(part)})
        for info in found:
            if info.zid == router:
                info.routers = linked
        return sorted(found, key=lambda info: info.zid)

    async def _try_rights(self, place: _Place) -> Rights:
        first, second, wait_s = place.first, place.second, place.waited_s
        kind, number = self._principal.agent
        rights = Rights()
        watched: list[str] = []
        place.kept.append(second.watch_tokens(PRESENCE.every(), lambda key, alive: watched.append(key)))
        key = PRESENCE.of(type=kind, id=number, group=self._principal.group, zid=first.zid)
        place.mark = _marked(key)
        place.kept.append(first.declare_token(place.mark))
        rights.seen = await self._shows_up(second, PRESENCE.every(), place.mark, wait_s)
        if rights.seen:
            rights.watches = await _until(lambda: place.mark in watched, wait_s)
        rights.sees = rights.seen or bool(place.facts.leases or await self._tokens(first, PRESENCE.every())) or None
        if self._principal.kind == "gateway":
            lease = _marked(LEASE.of(block=self._principal.number, zid=first.zid))
            place.kept.append(first.declare_token(lease))
            rights.leases = await self._shows_up(second, LEASE.every(), lease, wait_s)
        if self._principal.joins:
            rights.hears = await self._hears(place, kind, number)
        rights.pings = await self._pings(place)
        return rights

    async def _shows_up(self, mesh: Mesh, every: str, key: str, wait_s: float) -> bool:
        deadline, pause_s = time.monotonic() + wait_s, 0.01
        while key not in await mesh.tokens(every, timeout_s=self._timeout_s):
            if time.monotonic() > deadline:
                return False
            await asyncio.sleep(pause_s)
            pause_s *= 2  # each time everybody's tokens are asked for
        return True

    async def _hears(self, place: _Place, kind: int, number: int) -> bool:
        """Send to our own inbox with one session and listen with the other."""
        heard: list[str] = []
        key = UNICAST.of(type=kind, block=block_of(number), id=number, from_type=kind, from_id=number)
        gateway = self._principal.kind == "gateway"
        ours = UNICAST.every(type=kind, block=self._principal.number) if gateway else inbox(kind, number)
        listening = place.second.subscribe(ours, lambda batch: heard.extend(sent_to for sent_to, _ in batch))
        arrived = await self._repeat(lambda: place.first.put(key, PROBE), lambda: key in heard, place.waited_s)
        listening.close()
        return arrived

    async def _pings(self, place: _Place) -> bool:
        deadline = time.monotonic() + place.waited_s
        while True:
            try:
                await place.first.query(PING.of(zid=place.second.zid), b"", timeout_s=self._timeout_s)
            except MacsError:
                if time.monotonic() > deadline:
                    return False
                await asyncio.sleep(0.02)
            else:
                return True

    async def _repeat(self, act: Callable[[], None], done: Callable[[], bool], wait_s: float) -> bool:
        deadline = time.monotonic() + wait_s
        while not done():
            if time.monotonic() > deadline:
                return False
            act()
            await _until(done, 0.05)
        return True

    async def _meet(self, places: list[_Place]) -> None:
        """Which endpoints' sessions see the tokens of which."""
        wait_s = max((place.waited_s for place in places), default=0.0)
        for place in places:
            for other in places:
                if other is place or not other.facts.rights.seen or not place.facts.rights.seen:
                    continue
                if await self._shows_up(place.first, PRESENCE.every(), other.mark, wait_s):
                    place.facts.meets.append(other.facts.endpoint)

    async def _compare(self, places: list[_Place]) -> None:
        """What an endpoint does not show of what others do that it meets. Who just comes or leaves does not count."""
        suspected = _missing(places, [place.facts.presence for place in places])
        if not any(suspected):
            return
        await asyncio.sleep(max(place.waited_s for place in places))
        shown = await asyncio.gather(*(self._tokens(place.first, PRESENCE.every()) for place in places))
        for place, before, now in zip(places, suspected, _missing(places, shown), strict=True):
            place.facts.misses = sorted(before & now)

    # -- measurements --------------------------------------------------------------------------------------------

    async def _measure(self, place: _Place) -> None:
        if place.facts.rights.pings:
            place.facts.way.clock = await self._router_clock(place)
            if not self._quick:
                await self._echo(place.first, place.second.zid, place.facts.way)

    async def _round_trip(self, mesh: Mesh, key: str, way: Way) -> bytes | None:
        """One query; the answer if anybody answers. A router ends a query that nobody serves, or may ask, at once."""
        began = time.monotonic()
        try:
            answer: bytes | None = await mesh.query(key, b"", timeout_s=self._timeout_s)
        except CallTimeout:
            return None
        except MacsError:
            answer = None
        way.round_trips_ms.append(round((time.monotonic() - began) * 1000, 3))
        return answer

    async def _router_clock(self, place: _Place) -> Clock | None:
        """The router's clock, from the timestamps that it puts on what passes."""
        stamps: list[tuple[float, str, float]] = []
        key = PING.of(zid=place.second.zid)
        watching = place.second.watch_stamps(key, lambda stamp_s, zid: stamps.append((stamp_s, zid, time.time())))
        best: Clock | None = None
        for _ in range(PINGS):
            stamps.clear()
            sent_s = time.time()
            place.first.put(key, b"", Traffic.CALL)
            await _until(lambda: bool(stamps), place.waited_s)
            for stamp_s, zid, heard_s in stamps[:1]:
                if zid == place.facts.router:
                    best = _better(best, _clock(sent_s, stamp_s, heard_s))
        watching.close()
        return best

    async def _echo(self, mesh: Mesh, zid: str, way: Way) -> None:
        """Ever larger echoes, until one takes long or does not come back."""
        for size in ECHO_BYTES:
            began = time.monotonic()
            self._bytes += 2 * size
            try:
                await mesh.query(PING.of(zid=zid), bytes(size), timeout_s=self._timeout_s, traffic=Traffic.PROBE)
            except MacsError:
                way.lost_bytes = size
                return
            took_s = time.monotonic() - began
            way.echoes.append(Echo(size_bytes=size, took_s=round(took_s, 6)))
            if took_s - way.echoes[0].took_s > ECHO_S:
                return

    async def _visit(self, place: _Place, programs: list[Program]) -> None:
        """Ping everybody, one after the other: side by side they would measure each other."""
        for number, program in enumerate(programs):
            self._say(f"{', '.join(program.agents[:3]) or program.zid} ({number + 1} of {len(programs)})")
            if place.facts.rights.pings:
                await self._ping(place.first, program)
            if program.pong is not None and not self._quick and number < MAX_ECHOED:
                await self._echo(place.first, program.zid, program.way)
            if self._principal.calls and program.agents and not program.blocks:
                program.called = await self._call(place.first, program.agents[0])

    async def _ping(self, mesh: Mesh, program: Program) -> None:
        best: Clock | None = None
        for _ in range(PINGS):
            sent_s = time.time()
            way = Way()
            answer = await self._round_trip(mesh, PING.of(zid=program.zid), way)
            if answer is None:
                return
            program.way.round_trips_ms += way.round_trips_ms
            try:
                program.pong, _ = ping.decode(answer)
            except WireError:
                return
            best = _better(best, _clock(sent_s, program.pong.time_s, time.time()))
        program.way.clock = best

    async def _call(self, mesh: Mesh, agent: str) -> bool | None:
        """Call a robot, as one of the gateway's headsets or as an operator; None for agents that are no robots."""
        kind, _, number = agent.partition("/")
        if kind != type_name(ROS):
            return None
        sender = self._principal.agent
        for verb in CALLED:
            key, frame = call((ROS, int(number)), verb, sender, b"", Metadata(*sender))
            try:
                await mesh.query(key, frame, timeout_s=self._timeout_s)
            except Refused:
                return True
            except MacsError:
                continue
            return True
        return False


def endpoints_of(zenoh: dict[str, Any], way: str = "connect") -> Iterable[str]:
    """The endpoints to connect to, or to listen on: Zenoh allows one list, or one per mode."""
    wanted = at(zenoh, f"{way}/endpoints") or []
    if isinstance(wanted, dict):
        wanted = wanted.get(zenoh.get("mode") or "client") or []
    for endpoint in wanted:
        yield from (endpoint if isinstance(endpoint, list) else [endpoint])


def at(zenoh: dict[str, Any], path: str) -> Any:
    """A value of Zenoh's configuration, None where there is none."""
    value: Any = zenoh
    for name in path.split("/"):
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _marked(key: str) -> str:
    """The same key with a last chunk that nobody of ours reads."""
    begin, _, zid = key.rpartition("/")
    return f"{begin}/{_MARK}{zid}"


def _is_zid(text: str) -> bool:
    return bool(text) and set(text) <= set("0123456789abcdef")


def _router_info(answer: dict[str, Any]) -> RouterInfo:
    sessions = [
        Session(
            zid=session["peer"],
            whatami=session["whatami"],
            shared_memory=bool(session.get("shm")),
            address=next((link["dst"] for link in session["links"]), ""),
        )
        for session in answer["sessions"]
    ]
    return RouterInfo(zid=answer["zid"], version=answer["version"], sessions=sessions)


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
            of(str(fields["zid"])).blocks.append(int(fields["block"]))
    return list(found.values())


def _clock(sent_s: float, theirs_s: float, heard_s: float) -> Clock:
    return Clock(offset_s=round(theirs_s - (sent_s + heard_s) / 2, 6), within_s=round((heard_s - sent_s) / 2, 6))


def _better(one: Clock | None, other: Clock) -> Clock:
    return other if one is None or other.within_s < one.within_s else one


async def _until(condition: Callable[[], bool], timeout_s: float) -> bool:
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            return False
        await asyncio.sleep(0.002)
    return True


def _missing(places: list[_Place], shown: list[list[str]]) -> list[set[str]]:
    """For each endpoint what it does not show of what those of other routers show that it meets."""
    missing = []
    for place, own in zip(places, shown, strict=True):
        there: set[str] = set()
        for other, keys in zip(places, shown, strict=True):
            if other.facts.endpoint in place.facts.meets and other.facts.router != place.facts.router:
                there.update(keys)
        missing.append(there.difference(own))
    return missing
