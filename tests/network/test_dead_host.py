"""Whether a TCP agent's host has died is told apart from whether its program stands still."""

from __future__ import annotations

import json
import subprocess
import sys

from tests.network.hosts import Host, Network

SERVE = """
import json, socket, time
from bridge.gateway.tcp import is_gone, tune
listener = socket.create_server(("0.0.0.0", 7000))
print("ready", flush=True)
socks = {}
for _ in range(3):
    sock, _ = listener.accept()
    name = sock.recv(10).decode()
    tune(sock)
    sock.setblocking(False)
    socks[name] = sock
print("all", flush=True)
began, gone = time.monotonic(), {}
while time.monotonic() < began + 27 and len(gone) < 3:
    for name, sock in socks.items():
        if name in gone:
            continue
        try:
            if name != "idle":  # "reads" takes it until its host dies, "frozen" never
                sock.send(bytes(100 if name == "reads" else 1 << 20))
            sock.recv(1)
        except BlockingIOError:
            pass
        except OSError:
            gone[name] = time.monotonic() - began
        if is_gone(sock):
            gone.setdefault(name, time.monotonic() - began)
    time.sleep(0.25)
print(json.dumps(gone), flush=True)
"""
TAKE = """
import socket, sys
socks = []
for name in sys.argv[2:]:
    socks.append(socket.create_connection((sys.argv[1], 7000)))
    socks[-1].send(name.encode())
while "reads" in sys.argv and socks[0].recv(1 << 16):
    pass
sys.stdin.read()
"""


def test_a_dead_host_is_noticed_and_a_frozen_program_is_not(network: Network) -> None:
    """Soon after a host has died its connections are known to be gone, whether data is on its way or not; a program
    that stands still on a living host keeps its connection."""
    gateway, dying, living = (network.host(name) for name in ("gateway", "dying", "living"))
    link = network.link(gateway, dying, delay_ms=1)
    network.link(gateway, living, delay_ms=1)

    def start(host: Host, script: str, *words: str) -> subprocess.Popen[str]:
        command = [*host.within, sys.executable, "-c", script, *words]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    with start(gateway, SERVE) as serving:
        assert serving.stdout is not None
        assert serving.stdout.readline() == "ready\n"
        takers = [
            start(dying, TAKE, gateway.address_towards(dying), "reads"),
            start(dying, TAKE, gateway.address_towards(dying), "idle"),
            start(living, TAKE, gateway.address_towards(living), "frozen"),
        ]
        try:
            assert serving.stdout.readline() == "all\n"
            link.down()
            gone = json.loads(serving.stdout.readline())
        finally:
            for taker in takers:
                taker.kill()
                taker.wait()
    assert set(gone) == {"reads", "idle"}
