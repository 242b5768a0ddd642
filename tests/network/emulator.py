"""A network link between two TUN devices, with delay, loss and a rate: ``tc netem`` for kernels that have none.

``python -m tests.network.emulator LEFT RIGHT`` makes two TUN devices, says ``ready``, and carries IP packets between
them until its standard input ends. The devices may be moved into network namespaces while it runs. A line ``down`` on
standard input cuts the link, in silence as somewhere in the internet: what is sent is lost. ``up`` mends it.

Each direction is a bottleneck with a queue in front of it, as in a modem: a packet waits until those before it have
been sent, is dropped when the queue is full (drop-tail), and after its own sending time is on its way for the delay.
Losses are random and come after the queue, as on a radio link. Nothing is reordered.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import random
import select
import struct
import sys
import time
from collections import deque
from contextlib import suppress

TUNSETIFF = 0x400454CA
IFF_TUN = 0x0001
IFF_NO_PI = 0x1000
"""From linux/if_tun.h."""
PACKET_BYTES = 65_536


class Direction:
    """One way of the link."""

    def __init__(
        self, into: int, *, delay_s: float, loss: float, bytes_per_s: float, queue_s: float, seed: int
    ) -> None:
        self._into = into
        self._delay_s = delay_s
        self._loss = loss
        self._bytes_per_s = bytes_per_s
        self._queue_s = queue_s
        self._random = random.Random(seed)
        self._sent_at = 0.0
        self._travelling: deque[tuple[float, bytes]] = deque()

    def take(self, packet: bytes, now: float) -> None:
        """A packet enters the link."""
        if self._bytes_per_s:
            if self._sent_at - now > self._queue_s:
                return
            self._sent_at = max(now, self._sent_at) + len(packet) / self._bytes_per_s
        if self._random.random() >= self._loss:
            self._travelling.append((max(now, self._sent_at) + self._delay_s, packet))

    def deliver(self, now: float) -> None:
        """Let those out that have arrived."""
        travelling = self._travelling
        while travelling and travelling[0][0] <= now:
            with suppress(OSError):  # the device is down: so is the link
                os.write(self._into, travelling.popleft()[1])

    def next_arrival(self) -> float | None:
        """When the next packet comes out."""
        return self._travelling[0][0] if self._travelling else None


def carry(left: int, right: int, there: Direction, back: Direction) -> None:
    """Carry packets between the two devices until standard input ends."""
    ways = {left: there, right: back}
    stdin = sys.stdin.fileno()
    up = True
    while True:
        arrivals = [at for way in ways.values() if (at := way.next_arrival()) is not None]
        pause_s = max(0.0, min(arrivals) - time.monotonic()) if arrivals else None
        readable, _, _ = select.select([*ways, stdin], [], [], pause_s)
        if stdin in readable:
            orders = os.read(stdin, 4096).decode().split()
            if not orders:
                return
            up = orders[-1] == "up"
        for device in ways.keys() & readable:
            with suppress(OSError):  # no more to read
                while True:
                    packet = os.read(device, PACKET_BYTES)
                    if up:
                        ways[device].take(packet, time.monotonic())
        now = time.monotonic()
        for way in ways.values():
            way.deliver(now)


def tun(name: str) -> int:
    """Make a TUN device; it exists until the descriptor is closed."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))
    return device


def main() -> None:
    """Make the devices, say so, carry."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("left")
    parser.add_argument("right")
    parser.add_argument("--delay-ms", type=float, default=0.0, help="one way")
    parser.add_argument("--loss", type=float, default=0.0, help="of all packets, 0 to 1, each way")
    parser.add_argument("--mbit", type=float, default=0.0, help="each way; 0: as fast as it goes")
    parser.add_argument("--queue-ms", type=float, default=100.0, help="how long a packet may wait at the bottleneck")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with suppress(OSError):
        os.nice(-10)  # a link does not wait for programs; not allowed in every container
    left, right = tun(args.left), tun(args.right)
    ways = [
        Direction(
            into,
            delay_s=args.delay_ms / 1000,
            loss=args.loss,
            bytes_per_s=args.mbit * 1e6 / 8,
            queue_s=args.queue_ms / 1000,
            seed=args.seed + number,
        )
        for number, into in enumerate((right, left))
    ]
    print("ready", flush=True)
    carry(left, right, *ways)


if __name__ == "__main__":
    main()
