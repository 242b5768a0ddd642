"""What the other tests here stand on: links do to packets what they say, and nothing is left behind."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from tests.network.hosts import Host, Network, run

ECHO = """
import socket
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as echo:
    echo.bind(("0.0.0.0", 7000))
    print("ready", flush=True)
    while True:
        data, sender = echo.recvfrom(2000)
        echo.sendto(data + sender[0].encode(), sender)
"""
ASK = """
import json, socket, sys, time
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asking:
    asking.settimeout(1)
    began = time.monotonic()
    for number in range(200):
        asking.sendto(bytes(1000), (sys.argv[1], 7000))
    came, first_s, last_s = [], 0, 0
    while True:
        try:
            came.append(asking.recvfrom(2000)[0][1000:].decode())
        except TimeoutError:
            break
        first_s = first_s or time.monotonic() - began
        last_s = time.monotonic() - began
print(json.dumps([len(came), sorted(set(came)), first_s, last_s]))
"""


def test_a_link_delays_loses_and_limits(network: Network) -> None:
    """Of 200 KB sent at once over 50 ms and 4 Mbit/s with 20 % loss, the first comes back after 100 ms, the last about
    0.4 s later, and about two thirds of them come at all; they come from the address of the NAT."""
    inside, gate, outside = (network.host(name) for name in ("inside", "gate", "outside"))
    network.cable(inside, gate)
    network.link(gate, outside, delay_ms=50, loss=0.2, mbit=4, queue_ms=1000)
    network.nat(gate, towards=outside)
    inside.default_route(gate)
    came, senders, first_s, last_s = _ask(inside, outside, outside.address_towards(gate))
    print(f"{came} of 200, the first after {first_s:.3f} s, the last after {last_s:.3f} s")
    assert 90 <= came <= 165
    assert senders == [gate.address_towards(outside)]
    assert 0.1 <= first_s < 0.2
    assert 0.4 <= last_s < 0.9


def test_a_link_that_is_down_carries_nothing(network: Network) -> None:
    """What is sent over a link that is down is lost; after it is up again, packets come as before."""
    left, right = network.host("left"), network.host("right")
    link = network.link(left, right, delay_ms=1)
    link.down()
    assert _ask(left, right, right.address_towards(left))[0] == 0
    link.up()
    assert _ask(left, right, right.address_towards(left))[0] > 0  # a receiver may drop some of a burst


def test_a_failure_leaves_nothing_behind(network: Network) -> None:
    """After an error inside the block there is no namespace, device or process of it any more."""
    with suppress(RuntimeError), Network() as doomed:
        left, right = doomed.host("left"), doomed.host("right")
        doomed.link(left, right, delay_ms=1)
        device = left.device_towards(right)
        raise RuntimeError
    assert left.namespace not in run("ip", "netns", "list")
    assert device not in run("ip", "link", "show")
    commands = [_command(process) for process in Path("/proc").glob("[0-9]*")]
    assert not [command for command in commands if device in command]


def _ask(asking: Host, echoing: Host, address: str) -> tuple[int, list[str], float, float]:
    """Send 200 packets of 1000 bytes; how many came back, as whose they were seen, when the first and last came."""
    echo = subprocess.Popen([*echoing.within, sys.executable, "-c", ECHO], stdout=subprocess.PIPE, text=True)
    with echo:
        assert echo.stdout is not None
        assert echo.stdout.readline() == "ready\n"
        try:
            came, senders, first_s, last_s = json.loads(run(*asking.within, sys.executable, "-c", ASK, address))
        finally:
            echo.kill()
    return came, senders, first_s, last_s


def _command(process: Path) -> str:
    try:
        return (process / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:  # it has just ended
        return ""
