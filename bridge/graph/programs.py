"""Programs of a mesh, asked by pings: who they are, how far their clocks are, what they noted of traced messages."""

from __future__ import annotations

import time

from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import ping, trace
from macs_zenoh.protocol.keyexpr import LEASE, PING
from macs_zenoh.protocol.trace import Offset, TraceRequest

ASK_S = 3.0
PINGS = 10
AHEAD_NS = 1e18
"""A clock that is further from ours, by thirty years, is none."""


class Programs:
    """Asks, in one session. ``names`` are those of sessions, as far as they are known."""

    def __init__(self, mesh: Mesh, timeout_s: float) -> None:
        self.names = {mesh.zid: "here"}
        self._mesh = mesh
        self._timeout_s = timeout_s

    async def gateways(self) -> list[str]:
        """The sessions of gateways, each named by the address at which headsets reach it."""
        leases = [LEASE.parse(key) for key in await self._mesh.tokens(LEASE.every(), timeout_s=self._timeout_s)]
        found = sorted({lease.zid for lease in leases if lease is not None})
        for zid in found:
            unnamed = f"gateway {zid[:8]}"
            if self.names.get(zid, unnamed) == unnamed:
                pong = await self.pong(zid)
                self.names[zid] = f"gateway {pong.address}" if pong is not None and pong.address else unnamed
        return found

    async def ask(self, zid: str, request: TraceRequest) -> trace.TraceAnswer | None:
        """Have a session mark and note, and tell what it noted; None where it does not answer."""
        asked = trace.encode_request(request)
        try:
            if zid == self._mesh.zid:
                return trace.decode_answer(self._mesh.tracing.answer(asked))
            answer = await self._mesh.query(PING.of(zid=zid), asked, timeout_s=ASK_S)
            return trace.decode_answer(ping.decode(answer)[1])
        except MacsError:
            return None

    async def pong(self, zid: str) -> ping.Pong | None:
        """What a session says of itself; None where it does not answer."""
        try:
            return ping.decode(await self._mesh.query(PING.of(zid=zid), b"", timeout_s=self._timeout_s))[0]
        except MacsError:
            return None

    async def clock(self, zid: str) -> Offset:
        """The clock of a session against ours; no difference is assumed where that is possible."""
        if zid == self._mesh.zid:
            return Offset(0.0, 0.0)
        best = Offset()
        for _ in range(PINGS):
            sent_ns = time.time_ns()
            pong = await self.pong(zid)
            heard_ns = time.time_ns()
            if pong is None:
                return best
            ahead_ns, within_ns = pong.time_s * 1e9 - (sent_ns + heard_ns) / 2, (heard_ns - sent_ns) / 2
            if abs(ahead_ns) < AHEAD_NS and (best.within_ns is None or within_ns < best.within_ns):
                best = Offset(ahead_ns, within_ns)
        same = best.within_ns is not None and abs(best.ahead_ns) <= best.within_ns
        return Offset(0.0, best.within_ns) if same else best
