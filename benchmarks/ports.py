"""The ports of one gateway: TLS and WebSocket against plain TCP, and what an idle connection costs.

A relay that does nothing but pass on, plain and over TLS with the same ends, says what TLS costs at the least.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.support.certificates import Authority
from tests.support.programs import free_port

from .cases import Pair, measured_round_trip, proved, rate, size_text, stream
from .figures import Figure
from .plan import KIB, Case, Plan, in_turn
from .processes import Stage

IDLE = 1000
MORE_US = 150.0
"""So much more one message may take over TLS or WebSocket, to the gateway and from it."""
IDLE_KIB = 150.0


def ports(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """TLS and WebSocket against the plain port of the same gateway, in one run; and 1 000 idle TLS connections."""
    with tempfile.TemporaryDirectory() as directory:
        authority = Authority(Path(directory) / "ca")
        certificate, key = map(str, authority.issue("gateway"))
        tls, web = free_port(), free_port()
        options = ["--tls-port", str(tls), "--web-port", str(web), "--certificate", certificate, "--key", key]
        plain = stage.gateway(stage.router(), *options)
        gateway = stage.programs[-1]
        at = {"plain": plain, "tls": tls, "websocket": web}
        pairs = {way: _connect(stage, way, port, str(authority.ca)) for way, port in at.items()}
        pairs["relay"] = _connect(stage, "plain", stage.relay(), "")
        pairs["tls relay"] = _connect(stage, "tls", stage.relay(certificate, key), str(authority.ca))
        for size, least in ((64, None), (KIB, None), (64 * KIB, {"tls": 0.8, "websocket": 0.7})):
            values = in_turn(plan.rounds, {way: stream(plan, pair, size) for way, pair in pairs.items()})
            for way in ("tls", "websocket"):
                name = f"1 to 1, {way}, {size_text(size)}"
                yield rate(name, size, values[way], values["plain"], "plain port", at_least=least and least[way])
            yield rate(f"1 to 1, tls, {size_text(size)}", size, values["tls"], values["tls relay"], "relay over TLS")
            name = f"1 to 1, relay over TLS, {size_text(size)}"
            yield rate(name, size, values["tls relay"], values["relay"], "plain relay")
        count = max(200, int(1500 * plan.scale))
        values = in_turn(plan.rounds, {way: measured_round_trip(plan, pairs[way], KIB, count) for way in at})
        for way in ("tls", "websocket"):  # a round trip is two ways through the gateway
            more = [one - other for one, other in zip(values[way], values["plain"], strict=True)]
            limit = [2 * MORE_US] * len(more)
            yield Figure(f"round trip, {way}, {size_text(KIB)}", values[way], values["plain"], "plain port", "us")
            yield Figure(f"… and how much more than plain, {way}", more, limit, "twice 150 us", "us", at_most=1.0)
        idle = [_idle(stage, gateway, tls, str(authority.ca)) for _ in range(1)]
        yield Figure("an idle TLS connection", idle, [IDLE_KIB], "150 KiB", "KiB", at_most=1.0)


def _connect(stage: Stage, way: str, port: int, authority: str) -> Pair:
    receiver, there = stage.worker("headset", port, 1, 0, way, authority)
    sender, here = stage.worker("headset", port, 1, 0, way, authority)
    return proved(Pair(way, sender, receiver, here["ids"][0], there["ids"]))


def _idle(stage: Stage, gateway: object, port: int, authority: str) -> float:
    """What one costs the gateway in KiB, of a thousand."""
    before = gateway.memory_mb  # type: ignore[attr-defined]
    stage.worker("headset", port, IDLE, 0, "tls", authority)
    time.sleep(1)
    after = gateway.memory_mb  # type: ignore[attr-defined]
    return float((after - before) * 1e6 / IDLE / KIB)


CASES: dict[str, Case] = {"ports": ports}
