"""How much a session's links to its routers have carried, as the kernel counts it; asked for, and else nothing."""

from __future__ import annotations

import os
import socket
import stat
import struct
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import endpoints

_COUNTS = struct.Struct("=QQ")
_COUNTS_AT = 120
"""Where Linux' ``struct tcp_info`` has tcpi_bytes_acked; tcpi_bytes_received follows it."""

_End = tuple[str, int]


class LinkBytes:
    """Of one process: it finds the sockets among its descriptors, since Zenoh does not give them."""

    def __init__(self) -> None:
        self._known: dict[tuple[_End, _End], int] = {}
        """By both ends of a link, the descriptor that it had."""

    def of(self, links: Collection[tuple[str, str]]) -> tuple[int, int] | None:
        """Bytes sent and received by all these links, each with its endpoint here and the one there; None where that
        is not known of each. It is of TCP and TLS, on Linux."""
        sent = received = 0
        for here, there in links:
            counts = self._counts(_end(here), _end(there))
            if counts is None:
                return None
            sent, received = sent + counts[0], received + counts[1]
        return (sent, received) if links else None

    def _counts(self, here: _End | None, there: _End | None) -> tuple[int, int] | None:
        if here is None or there is None:
            return None
        counts = _read(self._known.get((here, there), -1), here, there)
        if counts is not None:
            return counts
        self._known.clear()
        with suppress(OSError):
            for path in list(Path("/proc/self/fd").iterdir()):
                counts = _read(int(path.name), here, there)
                if counts is not None:
                    self._known[here, there] = int(path.name)
                    return counts
        return None


def _read(descriptor: int, here: _End, there: _End) -> tuple[int, int] | None:
    """What the socket behind a descriptor has carried, if it is the one between these ends."""
    try:
        if not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return None
        again = os.dup(descriptor)  # what is closed here must not be the one that is used
        try:
            found = socket.socket(fileno=again)
        except OSError:
            os.close(again)
            raise
        with found:
            if found.type != socket.SOCK_STREAM or found.family not in (socket.AF_INET, socket.AF_INET6):
                return None
            if found.getsockname()[:2] != here or found.getpeername()[:2] != there:
                return None
            told = found.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
    except (OSError, AttributeError):  # closed meanwhile, or there is no such thing here
        return None
    return _COUNTS.unpack_from(told, _COUNTS_AT) if len(told) >= _COUNTS_AT + _COUNTS.size else None


def _end(endpoint: str) -> _End | None:
    address = endpoints.address_of(endpoint) if endpoints.protocol_of(endpoint) in ("tcp", "tls") else None
    return None if address is None else (address.host, address.port)


def tell_of(mesh: Mesh) -> None:
    """Let whoever pings this session know what its links have carried."""
    counted = LinkBytes()
    mesh.carried = lambda: counted.of(mesh.links)
