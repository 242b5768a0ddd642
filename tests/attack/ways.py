"""The ways into a gateway: TCP as it is, TLS, and WebSocket. What an attacker says is the same on each.

By hand, like `raw`: nothing here uses the code under test.
"""

from __future__ import annotations

import base64
import os
import select
import socket
import ssl
import struct
import threading
from typing import Literal, Protocol

Way = Literal["tcp", "tls", "web"]
WAYS: tuple[Way, ...] = ("tcp", "tls", "web")
PIECE_BYTES = 256 << 10
"""Of a WebSocket message; gateways take up to 1 MiB."""


class Stream(Protocol):
    """What an attacker needs of a socket."""

    def sendall(self, data: bytes, /) -> object: ...
    def recv(self, count: int, /) -> bytes: ...
    def settimeout(self, seconds: float | None, /) -> None: ...
    def setsockopt(self, level: int, name: int, value: int | bytes, /) -> None: ...
    def shutdown(self, how: int, /) -> None: ...
    def close(self) -> None: ...


def opened(way: Way, connected: socket.socket) -> Stream:
    """Greet as this way wants it. Raises OSError."""
    if way == "tls":
        return Tls(connected)
    return WebSocket(connected) if way == "web" else connected


class Tls:
    """A socket of the library's must not read and write in two threads at once: this one takes turns."""

    def __init__(self, connected: socket.socket) -> None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        self._socket = context.wrap_socket(connected)
        self._timeout_s: float | None = None
        self._lock = threading.Lock()
        self.setsockopt, self.close = self._socket.setsockopt, self._socket.close

    def sendall(self, data: bytes) -> None:
        view = memoryview(data)
        while len(view):  # in pieces, between which answers are read
            with self._lock:
                self._socket.settimeout(self._timeout_s)
                self._socket.sendall(view[:PIECE_BYTES])
            view = view[PIECE_BYTES:]

    def recv(self, count: int) -> bytes:
        while True:
            with self._lock:
                self._socket.settimeout(0.0)
                try:
                    return self._socket.recv(count)
                except (ssl.SSLWantReadError, BlockingIOError):
                    pass
            if not select.select([self._socket], [], [], self._timeout_s)[0]:
                raise TimeoutError

    def settimeout(self, seconds: float | None) -> None:
        self._timeout_s = seconds

    def shutdown(self, how: int) -> None:
        socket.socket.shutdown(self._socket, how)


class WebSocket:
    """Binary messages, masked with zeros, so that what is sent need not be copied."""

    def __init__(self, connected: socket.socket) -> None:
        self._socket = connected
        self._came = b""
        self._left = 0
        """Of the message that is being read."""
        self.settimeout, self.setsockopt = connected.settimeout, connected.setsockopt
        self.shutdown, self.close = connected.shutdown, connected.close
        key = base64.b64encode(os.urandom(16)).decode()
        host, port = connected.getpeername()
        asked = (
            f"GET /macs HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: macs.v1\r\n\r\n"
        )
        connected.sendall(asked.encode())
        while b"\r\n\r\n" not in self._came:
            self._came += self._more()
        answer, _, self._came = self._came.partition(b"\r\n\r\n")
        if not answer.startswith(b"HTTP/1.1 101"):
            raise ConnectionError(answer[:100].decode(errors="replace"))

    def sendall(self, data: bytes) -> None:
        for begin in range(0, len(data), PIECE_BYTES):
            piece = data[begin : begin + PIECE_BYTES]
            size = len(piece)
            if size < 126:
                head = struct.pack(">BB", 0x82, 0x80 | size)
            elif size < 1 << 16:
                head = struct.pack(">BBH", 0x82, 0x80 | 126, size)
            else:
                head = struct.pack(">BBQ", 0x82, 0x80 | 127, size)
            self._socket.sendall(head + bytes(4) + piece)

    def recv(self, count: int) -> bytes:
        while not self._left:
            self._need(2)
            size, head = self._came[1] & 0x7F, 2
            if size >= 126:
                head = 4 if size == 126 else 10
                self._need(head)
                size = int.from_bytes(self._came[2:head], "big")
            self._came, self._left = self._came[head:], size
        if not self._came:
            self._came = self._more()
        taken = self._came[: min(count, self._left)]
        self._came, self._left = self._came[len(taken) :], self._left - len(taken)
        return taken

    def _need(self, count: int) -> None:
        while len(self._came) < count:
            self._came += self._more()

    def _more(self) -> bytes:
        more = self._socket.recv(1 << 16)
        if not more:
            raise ConnectionError("closed")
        return more
