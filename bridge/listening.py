"""Sockets that a gateway listens with: of both families where no family is meant, all on one port."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator

from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.addresses import EVERYWHERE, joined

BOTH_FAMILIES = ("", "::")
NOT_HERE = (errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL)
"""What a machine without IPv6 says of an address of it."""


def bound(host: str, port: int, *, shared: bool = False) -> list[socket.socket]:
    """Sockets bound to a host and a port, not listening yet; with port 0 all on one that is free.

    A name is bound with all addresses that it has. ``shared``: with others who share the port, and take connections in
    turn. Raises Unreachable.
    """
    sockets: list[socket.socket] = []
    missing: OSError | None = None
    try:
        for family, address in _addresses(host, port):
            try:
                at = sockets[0].getsockname()[1] if sockets else port
                sockets.append(_bind(family, (address[0], at, *address[2:]), shared=shared))
            except OSError as error:
                if error.errno not in NOT_HERE:
                    raise
                missing = error
        if not sockets:
            raise missing or OSError(errno.EADDRNOTAVAIL, "the name has no address")
    except (OSError, UnicodeError) as error:
        for opened in sockets:
            opened.close()
        why = getattr(error, "strerror", None) or str(error)
        raise Unreachable(joined(host, port), f"cannot listen there: {why}") from error
    return sockets


def _addresses(host: str, port: int) -> Iterator[tuple[int, tuple[str, int] | tuple[str, int, int, int]]]:
    if host in BOTH_FAMILIES:
        yield socket.AF_INET6, ("::", port, 0, 0)
        if not socket.has_dualstack_ipv6():
            yield socket.AF_INET, ("0.0.0.0", port)  # noqa: S104 - asked for
        return
    seen = set()
    for family, _, _, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE):
        if (family, address) not in seen:
            seen.add((family, address))
            yield family, address  # type: ignore[misc]


def _bind(family: int, address: tuple[object, ...], *, shared: bool) -> socket.socket:
    opened = socket.socket(family, socket.SOCK_STREAM)
    try:
        # connections of an earlier gateway on this port, which wait for their last minute, are in nobody's way
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if shared:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        if family == socket.AF_INET6:
            opened.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, address[0] != "::")
        opened.bind(address)
    except BaseException:
        opened.close()
        raise
    return opened


def for_others(host: str) -> str:
    """What others call a host that we listen on: for every address, this machine's in its network."""
    if host not in EVERYWHERE:
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # of a UDP socket: sends nothing
        except OSError:
            return socket.gethostname()
        address: str = probe.getsockname()[0]
        return address
