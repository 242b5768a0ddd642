"""What the way to a router or a program is like: round trips, clocks, throughput."""

from __future__ import annotations

import time

from macs_zenoh.errors import CallTimeout, MacsError, WireError
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol.keyexpr import PING
from macs_zenoh.protocol.ping import decode as decode_pong

from .facts import Clock, Echo, NetworkPath, Program
from .place import Place, until

PINGS = 5
ECHO_BYTES = (4 << 10, 64 << 10, 256 << 10, 1 << 20)
"""One after the other, while the last one took at most `ECHO_S` longer than the first: a slow link gets little."""
ECHO_S = 0.25


class Measurements:
    """Takes them, one after the other, and counts what they put on the mesh. ``timeout_s`` bounds each single one."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self.bytes = 0

    async def round_trip(self, mesh: Mesh, key: str, path: NetworkPath) -> bytes | None:
        """One query; the answer if anybody answers. A router ends a query that nobody serves, or may ask, at once."""
        began = time.monotonic()
        try:
            answer: bytes | None = await mesh.query(key, b"", timeout_s=self._timeout_s)
        except CallTimeout:
            return None
        except MacsError:
            answer = None
        path.round_trips_ms.append(round((time.monotonic() - began) * 1000, 3))
        return answer

    async def router_clock(self, place: Place) -> Clock | None:
        """The router's clock, from the timestamps that it puts on what passes."""
        stamps: list[tuple[float, str, float]] = []
        key = PING.of(zid=place.second.zid)
        watching = place.second.watch_stamps(key, lambda stamp_s, zid: stamps.append((stamp_s, zid, time.time())))
        best: Clock | None = None
        for _ in range(PINGS):
            stamps.clear()
            sent_s = time.time()
            place.first.put(key, b"", Traffic.CALL)
            await until(lambda: bool(stamps), place.waited_s)
            for stamp_s, zid, heard_s in stamps[:1]:
                if zid == place.facts.router:
                    best = _better(best, _clock(sent_s, stamp_s, heard_s))
        watching.close()
        return best

    async def drops_commands(self, place: Place) -> bool | None:
        """Whether the router drops, where a link is full, what has the priority of commands and says that it waits; it
        shows by how such a sample arrives. None: none does."""
        came: list[bool] = []
        key = PING.of(zid=place.second.zid)
        watching = place.second.watch_dropping(key, came.append)
        for _ in range(PINGS):
            place.first.put(key, b"", Traffic.INSISTING)
            if await until(lambda: bool(came), place.waited_s):
                break
        watching.close()
        return came[0] if came else None

    async def echo(self, mesh: Mesh, zid: str, path: NetworkPath) -> None:
        """Ever larger echoes, until one takes long or does not come back."""
        for size in ECHO_BYTES:
            began = time.monotonic()
            self.bytes += 2 * size
            try:
                await mesh.query(PING.of(zid=zid), bytes(size), timeout_s=self._timeout_s, traffic=Traffic.PROBE)
            except MacsError:
                path.lost_bytes = size
                return
            took_s = time.monotonic() - began
            path.echoes.append(Echo(size_bytes=size, took_s=round(took_s, 6)))
            if took_s - path.echoes[0].took_s > ECHO_S:
                return

    async def ping(self, mesh: Mesh, program: Program) -> None:
        best: Clock | None = None
        for _ in range(PINGS):
            sent_s = time.time()
            path = NetworkPath()
            answer = await self.round_trip(mesh, PING.of(zid=program.zid), path)
            if answer is None:
                return
            program.path.round_trips_ms += path.round_trips_ms
            try:
                program.pong, _ = decode_pong(answer)
            except WireError:
                return
            best = _better(best, _clock(sent_s, program.pong.time_s, time.time()))
        program.path.clock = best


def _clock(sent_s: float, theirs_s: float, heard_s: float) -> Clock:
    return Clock(offset_s=round(theirs_s - (sent_s + heard_s) / 2, 6), within_s=round((heard_s - sent_s) / 2, 6))


def _better(one: Clock | None, other: Clock) -> Clock:
    return other if one is None or other.within_s < one.within_s else one
