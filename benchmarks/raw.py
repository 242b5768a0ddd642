"""The baselines' workers: Zenoh-Python as it comes, one session per process, and plain TCP.

``python -m benchmarks.raw zenoh PORT`` joins the router on that port with Zenoh's own defaults, except that it finds
it by address and that shared memory is off (a robot and its gateway are seldom one host, and nothing of ours uses it).
``python -m benchmarks.raw tcp [PORT]`` listens, or connects there.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from .worker import serve

PATIENCE_S = 5.0


class RawZenoh:
    """One Zenoh session: publishes, subscribes, plays ping-pong."""

    def __init__(self, router_port: int) -> None:
        config = zenoh.Config()
        for path, value in (
            ("mode", "client"),
            ("connect/endpoints", [f"tcp/127.0.0.1:{router_port}"]),
            ("listen/endpoints", []),
            ("scouting/multicast/enabled", False),
            ("transport/shared_memory/enabled", False),
        ):
            config.insert_json5(path, json.dumps(value))
        self.session = zenoh.open(config)
        self._received = 0
        self._wanted = 0
        self._ended = 0.0
        self._all_here = threading.Event()
        self._declared: list[Any] = []

    def subscribe(self, key: str, direct: bool) -> dict[str, Any]:
        """Count what comes on a key. ``direct``: called by Zenoh's own threads, not through the default handler."""

        def take(sample: zenoh.Sample) -> None:
            sample.payload.to_bytes()
            self._received += 1
            if self._received == self._wanted:
                self._ended = time.monotonic()
                self._all_here.set()

        self.declare(key, take, direct=direct)
        return {}

    def publish(self, key: str, size: int, count: int) -> dict[str, Any]:
        """Put ``count`` samples as fast as they are taken, none of them dropped; returns when it began."""
        publisher = self.session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        payload = bytes(size)
        began = time.monotonic()
        for _ in range(count):
            publisher.put(payload)
        publisher.undeclare()  # type: ignore[no-untyped-call]
        return {"began": began}

    def drop(self, key: str) -> dict[str, Any]:
        """Hear what comes on a key and do nothing with it, until `dropped`."""
        self._dropping = self.declare(key, lambda sample: None, direct=True)
        return {}

    def dropped(self) -> dict[str, Any]:
        """No more of it."""
        self._dropping.undeclare()
        return {}

    def save(self, key: str, path: str) -> dict[str, Any]:
        """Write the bytes of what comes on a key to a file, until `saved`."""
        file = open(path, "wb")  # noqa: PTH123, SIM115 - closed in saved
        self._saving = self.declare(key, lambda sample: file.write(sample.payload.to_bytes()))
        self._file = file
        return {}

    def saved(self) -> dict[str, Any]:
        """No more of it."""
        self._saving.undeclare()
        self._file.close()
        return {}

    def expect(self, count: int) -> dict[str, Any]:
        """Begin to count: ``receive`` waits for so many."""
        self._all_here.clear()
        self._received, self._wanted, self._ended = 0, count, 0.0
        return {}

    def receive(self, timeout_s: float) -> dict[str, Any]:
        """Wait for what `expect` announced."""
        self._all_here.wait(timeout_s)
        return {"received": self._received, "ended": self._ended or time.monotonic()}

    def ping(self, size: int, count: int) -> dict[str, Any]:
        """Put on ``bench/ping`` and wait for ``bench/pong``; returns the seconds that each took."""
        arrived = threading.Semaphore(0)

        def take(sample: zenoh.Sample) -> None:
            sample.payload.to_bytes()
            arrived.release()

        subscriber = self.declare("bench/pong", take)
        publisher = self.session.declare_publisher("bench/ping", express=True)
        payload = bytes(size)
        times = []
        for _ in range(count):
            began = time.perf_counter()
            publisher.put(payload)
            if not arrived.acquire(timeout=PATIENCE_S):
                break
            times.append(time.perf_counter() - began)
        subscriber.undeclare()
        publisher.undeclare()  # type: ignore[no-untyped-call]
        return {"times": times}

    def echo(self) -> dict[str, Any]:
        """Answer every ``bench/ping`` with a ``bench/pong`` of the same bytes, from now on."""
        publisher = self.session.declare_publisher("bench/pong", express=True)
        self._declared.append(publisher)
        self.declare("bench/ping", lambda sample: publisher.put(sample.payload.to_bytes()))
        return {}

    def declare(self, key: str, take: Callable[[zenoh.Sample], None], *, direct: bool = False) -> Any:
        """Call ``take`` for what comes on a key; ``direct``: in Zenoh's own threads, without its default handler."""
        subscriber = self.session.declare_subscriber(
            key, zenoh.handlers.Callback(take, indirect=False) if direct else take
        )
        self._declared.append(subscriber)
        return subscriber


class RawTcp:
    """One TCP connection: plays ping-pong."""

    def __init__(self, port: int | None) -> None:
        self._server = None if port else socket.create_server(("127.0.0.1", 0))
        self._socket = self._connected(socket.create_connection(("127.0.0.1", port))) if port else None

    @property
    def port(self) -> int | None:
        """Where the other side connects."""
        return self._server.getsockname()[1] if self._server else None

    def ping(self, size: int, count: int) -> dict[str, Any]:
        """Send ``size`` bytes and wait for as many, ``count`` times; returns the seconds that each took."""
        assert self._socket is not None
        message, buffer = bytes(size), bytearray(size)
        times = []
        for _ in range(count):
            began = time.perf_counter()
            self._socket.sendall(message)
            self._take(self._socket, buffer)
            times.append(time.perf_counter() - began)
        return {"times": times}

    def echo(self, size: int, count: int) -> dict[str, Any]:
        """Send back ``count`` messages of ``size`` bytes."""
        if self._socket is None:
            assert self._server is not None
            self._socket = self._connected(self._server.accept()[0])
        buffer = bytearray(size)
        for _ in range(count):
            self._take(self._socket, buffer)
            self._socket.sendall(buffer)
        return {"answered": count}

    @staticmethod
    def _connected(sock: socket.socket) -> socket.socket:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return sock

    @staticmethod
    def _take(sock: socket.socket, buffer: bytearray) -> None:
        received = 0
        while received < len(buffer):
            got = sock.recv_into(memoryview(buffer)[received:])
            if not got:
                raise EOFError("the connection was closed")
            received += got


def main() -> None:
    """Run the worker."""
    kind, *port = sys.argv[1:]
    if kind == "tcp":
        tcp = RawTcp(int(port[0]) if port else None)
        serve({"port": tcp.port}, {"ping": tcp.ping, "echo": tcp.echo})
        return
    raw = RawZenoh(int(port[0]))
    names = ("subscribe", "drop", "dropped", "save", "saved", "publish", "expect", "receive", "ping", "echo")
    serve({}, {name: getattr(raw, name) for name in names})
    raw.session.close()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    main()
