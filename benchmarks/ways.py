"""Blocking sockets by each way to a gateway: plain TCP, TLS, and WebSocket, which all look like a plain one.

The ends should cost little beside what is measured. A client has to mask what it sends over a WebSocket; with a mask
of zeros that is nothing here, and as much as ever for the gateway.
"""

from __future__ import annotations

import socket
import ssl
import struct
from typing import Any

from macs_zenoh.protocol.websocket import MESSAGE_BYTES, SUBPROTOCOL, WEBSOCKET_PATH


def connect(port: int, way: str, authority: str, source: str = "") -> Any:
    """By ``plain``, ``tls`` or ``websocket``, to 127.0.0.1; from an address, if one is named."""
    sock = socket.create_connection(("127.0.0.1", port), source_address=(source, 0) if source else None)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if way == "plain":
        return sock
    if way == "websocket":
        return WebSocket(sock, port)
    return Tls(ssl.create_default_context(cafile=authority).wrap_socket(sock, server_hostname="127.0.0.1"))


class _Like:
    """What is passed on."""

    def __init__(self, sock: Any) -> None:
        self._sock = sock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sock, name)


class Tls(_Like):
    """A socket whose time to receive has run out says so as a plain one: Python's own TLS would try again for ever."""

    def setsockopt(self, level: int, option: int, value: Any) -> None:
        """As of a plain one."""
        if (level, option) == (socket.SOL_SOCKET, socket.SO_RCVTIMEO):
            seconds, micros = struct.unpack("ll", value)
            self._sock.settimeout(seconds + micros / 1e6)
        else:
            self._sock.setsockopt(level, option, value)

    def recv_into(self, buffer: Any) -> int:
        """Some bytes. Raises BlockingIOError."""
        try:
            return int(self._sock.recv_into(buffer))
        except TimeoutError as error:
            raise BlockingIOError from error


HEADER_BYTES = 10
"""So much at most a WebSocket message from a gateway has before what it carries."""


class WebSocket(_Like):
    """Binary messages in both directions, and of what comes only what they carry."""

    def __init__(self, sock: socket.socket, port: int) -> None:
        super().__init__(sock)
        self.raw = sock
        self._left = 0
        """Of the message that has begun."""
        self._ahead = bytearray()
        """What came behind the last message: the next one's header. To ask for that alone would be two more system
        calls for each message."""
        self._header = memoryview(bytearray(HEADER_BYTES))
        lines = [
            f"GET {WEBSOCKET_PATH} HTTP/1.1",
            f"Host: 127.0.0.1:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
            f"Sec-WebSocket-Protocol: {SUBPROTOCOL}",
            "",
            "",
        ]
        sock.sendall("\r\n".join(lines).encode())
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += sock.recv(1)

    def sendall(self, data: bytes) -> None:
        """In messages of the size that is allowed."""
        view = memoryview(data)
        for begin in range(0, len(view), MESSAGE_BYTES):
            piece = view[begin : begin + MESSAGE_BYTES]
            size = len(piece)
            header = (
                struct.pack("!BB", 0x82, 0x80 | size)
                if size < 126
                else struct.pack("!BBH", 0x82, 0xFE, size)
                if size < 1 << 16
                else struct.pack("!BBQ", 0x82, 0xFF, size)
            )
            self._sock.sendmsg([header, bytes(4), piece]) if size < 4096 else self._send(header + bytes(4), piece)

    def recv_into(self, buffer: Any) -> int:
        """Some bytes. Raises BlockingIOError."""
        while not self._left:
            first = self._exactly(2)
            if not first:
                return 0
            size = first[1] & 0x7F
            if size == 126:
                (size,) = struct.unpack("!H", self._exactly(2))
            elif size == 127:
                (size,) = struct.unpack("!Q", self._exactly(8))
            self._left = size
        room = memoryview(buffer)[: self._left]
        if self._ahead:  # of a small message not only the header
            got = min(len(room), len(self._ahead))
            room[:got] = self._ahead[:got]
            del self._ahead[:got]
            self._left -= got
            return got
        wanted = [room, self._header] if len(room) == self._left else [room]
        got = int(self._sock.recvmsg_into(wanted)[0])
        if got > self._left:
            self._ahead += self._header[: got - self._left]
            got = self._left
        self._left -= got
        return got

    def recv(self, size: int) -> bytes:
        """The same as bytes."""
        buffer = bytearray(size)
        return bytes(buffer[: self.recv_into(buffer)])

    def _send(self, header: bytes, piece: memoryview) -> None:
        sent = self._sock.sendmsg([header, piece])
        if sent < len(header):
            raise ConnectionError("not even a header went out")
        self._sock.sendall(piece[sent - len(header) :])

    def _exactly(self, size: int) -> bytes:
        data = self._ahead
        while len(data) < size:
            got = self._sock.recv(size - len(data))
            if not got:
                return b""
            data += got
        found = bytes(data[:size])
        del data[:size]
        return found
