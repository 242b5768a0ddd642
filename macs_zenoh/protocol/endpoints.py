"""Zenoh's endpoints, ``tls/[::1]:7447#verify_name_on_connect=false``, and where its configuration has them. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from .addresses import Address, joined

IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "quic_datagram", "ws")
"""Protocols whose endpoints have a host and a port."""
PROTOCOLS = (*IP_PROTOCOLS, "unixsock-stream", "unixpipe", "serial", "vsock")
TLS_PROTOCOLS = ("tls", "quic", "quic_datagram")


def written(protocol: str, host: str, port: int | str) -> str:
    """``tcp/10.0.0.1:7447``, with brackets where the host needs them."""
    return f"{protocol}/{joined(host, port)}"


def protocol_of(endpoint: str) -> str:
    """``tls`` of ``tls/10.0.0.1:7447``."""
    return endpoint.partition("/")[0]


def by_protocol(protocol: str, endpoint: str) -> str:
    """The same place by another protocol."""
    return f"{protocol}/{endpoint.partition('/')[2]}"


def address_of(endpoint: str) -> Address | None:
    """Where an endpoint is; None for those without host and port."""
    host, _, port = _place(endpoint).rpartition(":")
    if not host or not port.isascii() or not port.isdigit():
        return None
    return Address(host.removeprefix("[").removesuffix("]"), int(port))


def own_settings(endpoint: str) -> dict[str, str]:
    """What an endpoint says of its own link, after ``#``."""
    return dict(part.partition("=")[::2] for part in endpoint.partition("#")[2].split(";") if part)


def tls_settings(endpoint: str, common: Mapping[str, Any]) -> dict[str, Any]:
    """The TLS settings of an endpoint: Zenoh's ``transport/link/tls``, and what the endpoint itself says."""
    return {**{name: value for name, value in common.items() if value is not None}, **own_settings(endpoint)}


def problem(endpoint: str, *, lowest_port: int = 1) -> str:
    """Why an endpoint can never work, to be said behind it; empty for one that might."""
    if not re.fullmatch(r"[a-z][a-z0-9_.-]*/\S+", endpoint):
        complete = re.fullmatch(r"[\w.\[\]:-]+:\d+", endpoint)
        return "is not a Zenoh endpoint" + (f", write tcp/{endpoint}" if complete else ", as in tcp/10.0.0.1:7447")
    protocol = protocol_of(endpoint)
    if protocol not in PROTOCOLS:
        return f"begins with {protocol!r}, which is no protocol of Zenoh's: {', '.join(PROTOCOLS)}"
    if protocol not in IP_PROTOCOLS:
        return ""
    found = re.fullmatch(r"(.+):([0-9]+)", _place(endpoint))
    if found is None:
        return f"needs a host and a port, as in {protocol}/10.0.0.1:7447"
    if ":" in found[1] and not re.fullmatch(r"\[.+\]", found[1]):
        return f"needs brackets around its address: {written(protocol, found[1], found[2])}"
    if not lowest_port <= int(found[2]) <= 0xFFFF:
        return f"has the port {found[2]}, allowed is {lowest_port}..65535"
    return ""


def _place(endpoint: str) -> str:
    return re.split("[?#]", endpoint.partition("/")[2])[0]


# -- in Zenoh's configuration ----------------------------------------------------------------------------------------


def configured(zenoh: Mapping[str, Any], role: str = "connect") -> Iterator[str]:
    """The endpoints to connect to, or to ``listen`` on: Zenoh allows one list, or one per mode, and lists in it."""
    wanted = value_at(zenoh, f"{role}/endpoints") or []
    if isinstance(wanted, dict):
        wanted = wanted.get(zenoh.get("mode") or "client") or []
    for endpoint in wanted:
        yield from (endpoint if isinstance(endpoint, list) else [endpoint])


def value_at(zenoh: Mapping[str, Any], path: str) -> Any:
    """A value of Zenoh's configuration, None where there is none."""
    value: Any = zenoh
    for name in path.split("/"):
        value = value.get(name) if isinstance(value, dict) else None
    return value
