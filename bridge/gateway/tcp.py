"""What the kernel knows of a TCP socket: what nobody has read yet, whether there is still a host at the other end."""

from __future__ import annotations

import fcntl
import socket
import struct
import sys
import termios

DEAD_MS = 18_000
"""A host that has acknowledged nothing for so long, while something is on its way to it, is gone. One whose program
stands still acknowledges all the same."""


def waiting_bytes(sock: socket.socket) -> int:
    """How much has come that nobody has read."""
    try:
        return int.from_bytes(fcntl.ioctl(sock.fileno(), termios.FIONREAD, bytes(4)), sys.byteorder)
    except (OSError, ValueError):  # it is closed: asyncio's own sockets have no number then, which is no OSError
        return 0


def is_gone(sock: socket.socket) -> bool:
    """Whether data is on its way to a host that acknowledges nothing; while none is, keep-alive probes find out."""
    try:
        info = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 60)
    except (OSError, AttributeError):  # it is closed; not Linux
        return False
    (unacknowledged,), (since_ms,) = (struct.unpack_from("=I", info, at) for at in (24, 56))  # struct tcp_info
    return bool(unacknowledged) and since_ms >= DEAD_MS


def tune(sock: socket.socket) -> None:
    """No delay for small messages; dead hosts are noticed within about 20 s even where heartbeats are off. What a
    listening socket accepts has that of it: to say it of each would be a tenth of what a connection costs."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 10), ("TCP_KEEPINTVL", 3), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, name):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
