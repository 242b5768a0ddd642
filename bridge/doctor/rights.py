"""What a session with these settings may do, by trying: Zenoh refuses in silence, so a second session must see it."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from bridge.principal import Principal
from macs_zenoh.errors import MacsError, Refused
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import LEASE, PING, PRESENCE, UNICAST, marked, type_name
from macs_zenoh.protocol.messages import ROS, Metadata
from macs_zenoh.protocol.routing import call, inbox
from macs_zenoh.protocol.wire import PROBE

from .facts import Rights
from .place import MARK, Place, tokens, until

CALLED = ("ping", "status")
"""Calls without effect: every agent serves the first, robots the second, which access rules may allow alone."""


class Trial:
    """Tries the rights of a principal. ``timeout_s`` bounds each single step."""

    def __init__(self, principal: Principal, timeout_s: float) -> None:
        self._principal = principal
        self._timeout_s = timeout_s

    async def rights(self, place: Place) -> Rights:
        first, second, wait_s = place.first, place.second, place.waited_s
        kind, number = self._principal.agent
        rights = Rights()
        watched: list[str] = []
        place.kept.append(second.watch_tokens(PRESENCE.every(), lambda key, alive: watched.append(key)))
        key = PRESENCE.of(type=kind, id=number, group=self._principal.group, zid=first.zid)
        place.mark = marked(key, MARK)
        place.kept.append(first.declare_token(place.mark))
        rights.seen = await self.shows_up(second, PRESENCE.every(), place.mark, wait_s)
        if rights.seen:
            rights.watches = await until(lambda: place.mark in watched, wait_s)
        rights.sees = (
            rights.seen or bool(place.facts.leases or await tokens(first, PRESENCE.every(), self._timeout_s)) or None
        )
        if self._principal.kind == "gateway":
            lease = marked(LEASE.of(block=self._principal.number, zid=first.zid), MARK)
            place.kept.append(first.declare_token(lease))
            rights.leases = await self.shows_up(second, LEASE.every(), lease, wait_s)
        if self._principal.joins:
            rights.hears = await self._hears(place, kind, number)
        rights.pings = await self._pings(place)
        return rights

    async def shows_up(self, mesh: Mesh, every: str, key: str, wait_s: float) -> bool:
        deadline, pause_s = time.monotonic() + wait_s, 0.01
        while key not in await mesh.tokens(every, timeout_s=self._timeout_s):
            if time.monotonic() > deadline:
                return False
            await asyncio.sleep(pause_s)
            pause_s *= 2  # each time everybody's tokens are asked for
        return True

    async def _hears(self, place: Place, kind: int, number: int) -> bool:
        """Send to our own inbox with one session and listen with the other."""
        heard: list[str] = []
        key = UNICAST.of(type=kind, id=number, from_type=kind, from_id=number)
        gateway = self._principal.kind == "gateway"
        ours = UNICAST.every(type=kind, block=self._principal.number) if gateway else inbox(kind, number)
        listening = place.second.subscribe(ours, lambda batch: heard.extend(sent_to for sent_to, _ in batch))
        arrived = await self._repeat(lambda: place.first.put(key, PROBE), lambda: key in heard, place.waited_s)
        listening.close()
        return arrived

    async def _pings(self, place: Place) -> bool:
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

    async def _repeat(self, act: Callable[[], object], done: Callable[[], bool], wait_s: float) -> bool:
        deadline = time.monotonic() + wait_s
        while not done():
            if time.monotonic() > deadline:
                return False
            act()
            await until(done, 0.05)
        return True

    async def call(self, mesh: Mesh, agent: str) -> bool | None:
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
