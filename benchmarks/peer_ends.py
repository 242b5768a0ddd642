"""Workers that speak other programs' protocols, to put these beside ours: clients of rosbridge and ROS-TCP-Endpoint.

``python -m benchmarks.peer_ends rosbridge|ros-tcp HOST PORT`` connects to a program that the user has started. It
publishes and receives what `benchmarks.robot_ends` does, stamped in the same way.
"""

from __future__ import annotations

import base64
import json
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from .robot_ends import AT, PREFIX, TYPE, Arrivals, pace, stamped
from .worker import serve

_U32 = struct.Struct("<I")


class Peer(Protocol):
    """A connection to one of them."""

    def subscribe(self, topic: str) -> None:
        """Receive a topic."""

    def advertise(self, topic: str) -> None:
        """Be about to publish a topic."""

    def publish(self, topic: str, cdr: bytearray) -> None:
        """Publish a message, given as CDR."""

    def feed(self, data: bytes) -> Iterator[bytes]:
        """CDR of each message that is whole with these bytes."""


class RosTcp:
    """ROS-TCP-Endpoint: destination and data, each with its length; CDR as it is."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._buffer = bytearray()

    def subscribe(self, topic: str) -> None:
        self._command("__subscribe", {"topic": topic, "message_name": TYPE})

    def advertise(self, topic: str) -> None:
        self._command("__publish", {"topic": topic, "message_name": TYPE, "queue_size": 1000, "latch": False})

    def publish(self, topic: str, cdr: bytearray) -> None:
        self._send(topic, bytes(cdr))

    def feed(self, data: bytes) -> Iterator[bytes]:
        buffer = self._buffer
        buffer += data
        while len(buffer) >= 4:
            body_at = 4 + _U32.unpack_from(buffer)[0]
            if len(buffer) < body_at + 4:
                return
            end = body_at + 4 + _U32.unpack_from(buffer, body_at)[0]
            if len(buffer) < end:
                return
            topic, cdr = bytes(buffer[4:body_at]), bytes(buffer[body_at + 4 : end])
            del buffer[:end]
            if not topic.startswith(b"__"):  # it talks of itself
                yield cdr

    def _command(self, name: str, what: dict[str, object]) -> None:
        self._send(name, json.dumps(what).encode())

    def _send(self, destination: str, data: bytes) -> None:
        name = destination.encode()
        self._socket.sendall(b"".join((_U32.pack(len(name)), name, _U32.pack(len(data)), data)))


class Rosbridge:
    """rosbridge: JSON in WebSocket frames, bytes in base64."""

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._buffer = bytearray()
        key = base64.b64encode(os.urandom(16)).decode()
        lines = ("GET / HTTP/1.1", "Host: peer", "Upgrade: websocket", "Connection: Upgrade")
        asked = [*lines, f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "", ""]
        sock.sendall("\r\n".join(asked).encode())
        answer = bytearray()
        while b"\r\n\r\n" not in answer:
            piece = sock.recv(4096)
            if not piece:
                raise ConnectionError(f"no WebSocket: {bytes(answer[:200])!r}")
            answer += piece
        head, _, rest = bytes(answer).partition(b"\r\n\r\n")
        if b" 101 " not in head.splitlines()[0]:
            raise ConnectionError(f"no WebSocket: {head[:200]!r}")
        self._buffer += rest

    def subscribe(self, topic: str) -> None:
        self._send({"op": "subscribe", "topic": topic, "type": TYPE.replace("/", "/msg/"), "queue_length": 1000})

    def advertise(self, topic: str) -> None:
        self._send({"op": "advertise", "topic": topic, "type": TYPE.replace("/", "/msg/")})

    def publish(self, topic: str, cdr: bytearray) -> None:
        data = base64.b64encode(cdr[AT:]).decode()
        layout = {"dim": [], "data_offset": 0}
        self._send({"op": "publish", "topic": topic, "msg": {"layout": layout, "data": data}})

    def feed(self, data: bytes) -> Iterator[bytes]:
        self._buffer += data
        while (text := self._frame()) is not None:
            said = json.loads(text) if text else {}
            if said.get("op") == "publish":
                found = base64.b64decode(said["msg"]["data"])
                yield PREFIX + _U32.pack(len(found)) + found

    def _frame(self) -> bytes | None:
        """The next frame's payload, empty for those that are no text; a server's are not masked."""
        buffer = self._buffer
        if len(buffer) < 2:
            return None
        size, at = buffer[1] & 127, 2
        if size > 125:
            at += 2 if size == 126 else 8
            if len(buffer) < at:
                return None
            size = int.from_bytes(buffer[2:at], "big")
        if len(buffer) < at + size:
            return None
        payload = bytes(buffer[at : at + size]) if buffer[0] & 15 == 1 else b""
        del buffer[: at + size]
        return payload

    def _send(self, what: dict[str, object]) -> None:
        payload = json.dumps(what).encode()
        size = len(payload)
        length = struct.pack(">B", 128 | size) if size < 126 else struct.pack(">BH", 254, size)
        if size > 0xFFFF:
            length = struct.pack(">BQ", 255, size)
        self._socket.sendall(b"\x81" + length + bytes(4) + payload)  # masked with zeros, which changes nothing


KINDS: dict[str, Callable[[socket.socket], Peer]] = {"rosbridge": Rosbridge, "ros-tcp": RosTcp}


class PeerEnd:
    """One client."""

    def __init__(self, kind: str, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._peer = KINDS[kind](self._socket)

    def subscribe(self, topic: str) -> dict[str, Any]:
        """Receive a topic."""
        self._peer.subscribe(topic)
        return {}

    def advertise(self, topic: str) -> dict[str, Any]:
        """Be about to publish a topic."""
        self._peer.advertise(topic)
        return {}

    def publish(self, topic: str, size: int, hz: float, count: int) -> dict[str, Any]:
        """Publish at a rate."""
        began = time.monotonic()
        pace(count, hz, lambda cdr: self._peer.publish(topic, cdr), stamped(size))
        return {"took_s": time.monotonic() - began}

    def collect(self, count: int, quiet_s: float) -> dict[str, Any]:
        """Wait for so many, or until nothing has come for a while. A message has come with its last bytes."""
        arrivals = Arrivals()
        arrivals.last = time.monotonic()
        while len(arrivals.latencies) < count and time.monotonic() - arrivals.last < quiet_s:
            if not select.select([self._socket], [], [], 0.1)[0]:
                continue
            piece, now = self._socket.recv(1 << 20), time.monotonic()
            if not piece:
                break
            for cdr in self._peer.feed(piece):
                arrivals.note(cdr, now)
        return arrivals.report()


def main() -> None:
    """Run the worker."""
    end = PeerEnd(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    serve({}, {name: getattr(end, name) for name in ("subscribe", "advertise", "publish", "collect")})


if __name__ == "__main__":
    main()
