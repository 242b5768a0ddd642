"""How a host and a port are written: ``10.0.0.1:7000``, ``gateway.local:7000``, ``[fe80::1%eth0]:7000``. Pure.

One notation for options, settings and messages, so that what a program prints can be given to another one. An IPv6
address with a port is in brackets; alone it may be. Zenoh's endpoints have a protocol before it: ``tcp/[::1]:7447``.
"""

from __future__ import annotations

import ipaddress
import re
from typing import NamedTuple

EVERYWHERE = frozenset({"", "0.0.0.0", "::"})  # noqa: S104 - recognised, not bound here
"""Hosts that mean every address of this machine: ``::`` with both families, as programs of today understand it."""

_NAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_.-]*[A-Za-z0-9_])?\.?")


class Address(NamedTuple):
    """A host, without brackets, and a port."""

    host: str
    port: int

    def __str__(self) -> str:
        return joined(self.host, self.port)


def joined(host: str, port: int | str) -> str:
    """``host:port``, with brackets where the host needs them."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def bare(host: str) -> str:
    """A host without a port, and without brackets. Raises ValueError, with a sentence about what is wrong."""
    inside = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if _is_ipv6(inside):
        return inside
    if not host or _NAME.fullmatch(host):
        return host
    name, colon, port = host.rpartition(":")
    apart = f", the port {port} is said apart" if colon and (_NAME.fullmatch(name) or name.endswith("]")) else ""
    raise ValueError(f"{host!r} is no host name and no address{apart}")


def parse(text: str, default_port: int) -> Address:
    """``HOST``, ``HOST:PORT``, ``[IPV6]:PORT`` or ``IPV6``. Raises ValueError, with a sentence about what is wrong."""
    if "/" in text:
        raise ValueError(f"{text!r} is an endpoint of Zenoh's; say HOST:PORT, as in 10.0.0.1:{default_port}")
    if _is_ipv6(text):
        return Address(text, default_port)
    if text.startswith("["):
        host, closed, after = text.partition("]")
        host, colon, port = host + closed, after[:1], after[1:]
        if after and colon != ":":
            raise ValueError(f"{text!r} is no HOST:PORT")
    else:
        host, colon, port = text.partition(":")
    if not colon:
        port = str(default_port)
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 1 << 16:
        raise ValueError(f"{text!r} is no HOST:PORT")
    return Address(bare(host), int(port))


def of_peer(host: str) -> str:
    """The address of somebody who has connected: one of IPv4 as such, also on a socket of both families."""
    mapped = host.lower().removeprefix("::ffff:")
    return mapped if mapped != host.lower() and "." in mapped else host


def is_local(host: str) -> bool:
    """Whether only programs of this machine reach what listens on a host."""
    try:
        return ipaddress.ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return host == "localhost"


def reachable(host: str) -> str:
    """Where a program of this machine reaches what listens on ``host``."""
    return "127.0.0.1" if host in EVERYWHERE else host


def _is_ipv6(text: str) -> bool:
    try:
        ipaddress.IPv6Address(text)
    except ValueError:
        return False
    return True
