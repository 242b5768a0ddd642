"""What happens at a gateway's door, timed: a token that is revoked, and bad WebSockets beside somebody who works."""

from __future__ import annotations

import os
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.programs import free_port

from . import ways
from .cases import connect, measured_round_trip
from .figures import Figure
from .plan import KIB, Case, Plan
from .processes import Stage

CONNECTIONS = 100
REVOKED_S = 1.0
NEIGHBOUR = 1.2
"""So many times as long a message may take beside bad input, in one run."""
PIECES = {
    "larger than a message may be": b"\x82\xff" + (1 << 21).to_bytes(8, "big") + bytes(1 << 16),
    "a flood of pings": b"\x89\x81" + bytes(4) + b"x",
    "fragments without end": b"\x02\xfe" + (1 << 15).to_bytes(2, "big") + bytes(4) + bytes(1 << 15),
    "compressed": b"\xc2\xe4" + bytes(104),
    "slow headers": b"",
}


def revoked(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """A token is revoked that has 100 connections open: how long until the last of them has ended."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "macs" / "tokens.json"
        secret = new_secret(os.urandom(32))
        token = Token(name="all", rights=Rights(may=["see"]), hashes=[hash_of(secret)])
        took = []
        for _ in range(plan.rounds):
            store.change(path, lambda tokens: (tokens.with_token(token), None))
            port = stage.gateway(stage.router(), "--tokens", str(path), "--without-token", "nobody")
            worker, _ = stage.worker("headset", port, CONNECTIONS, 0, "plain", "", secret)
            time.sleep(0.5)
            worker.tell("receive", total_bytes=1 << 30, timeout_s=10)
            began = time.monotonic()
            store.change(path, lambda tokens: (tokens.without("all"), None))
            took.append(worker.answer()["ended"] - began)
        limit = [REVOKED_S] * len(took)
        yield Figure(f"revoked, {CONNECTIONS} connections end after", took, limit, "1 s", "s", at_most=1.0)


def bad_websockets(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """Bad WebSockets, one after the other: what a message takes that two others of the gateway send each other."""
    web = free_port()
    port = stage.gateway(stage.router(), "--web-port", str(web))
    pair = connect(stage, "one gateway", port, port)
    run = measured_round_trip(plan, pair, KIB, max(200, int(1500 * plan.scale)))
    for name, piece in PIECES.items():
        calm, beside = [], []
        for _ in range(plan.rounds):
            calm.append(run())
            ended = threading.Event()
            attacker = threading.Thread(target=_attack, args=(web, piece, ended))
            attacker.start()
            beside.append(run())
            ended.set()
            attacker.join()
        yield Figure(f"beside {name}", beside, calm, "alone", "us", at_most=NEIGHBOUR)


def _attack(port: int, piece: bytes, ended: threading.Event) -> None:
    """Ten times a second a connection that sends what is wrong, as long as it is let."""
    while not ended.wait(0.1):
        with suppress(OSError):
            if not piece:
                with socket.create_connection(("127.0.0.1", port), timeout=1) as slow:
                    slow.sendall(b"GET /macs HTTP/1.1\r\nX: ")
                    ended.wait(0.1)
                continue
            attacker = ways.WebSocket(socket.create_connection(("127.0.0.1", port), timeout=1), port)
            attacker.settimeout(1)
            for _ in range(50):
                attacker.raw.sendall(piece)
            attacker.close()


CASES: dict[str, Case] = {"revoked": revoked, "bad-websockets": bad_websockets}
