"""Who may connect: addresses, and how many of them. Pure."""

from __future__ import annotations

import ipaddress
from collections import Counter
from collections.abc import Mapping, Sequence


class Admission:
    """The limits on connections: ``allow`` lists networks (CIDR, empty = everybody), ``groups`` who
    may choose a group."""

    def __init__(
        self,
        allow: Sequence[str],
        max_connections: int,
        max_per_address: int,
        groups: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._allow = _networks(allow)
        self._groups = {int(group): _networks(networks) for group, networks in (groups or {}).items()}
        self._max_connections = max_connections
        self._max_per_address = max_per_address
        self._inside: Counter[str] = Counter()

    def judge(self, address: str) -> tuple[str, str] | None:
        """Why a connection from this address is refused: the name of its counter, and a sentence; None lets it in."""
        if self._allow and not _is_in(address, self._allow):
            return "address_not_allowed", "its address is not in gateway.allow"
        if self._inside.total() >= self._max_connections:
            return "too_many_connections", f"{self._max_connections} are connected (gateway.max_connections)"
        if self._inside[address] >= self._max_per_address:
            limit = f"{self._max_per_address} are connected from there (gateway.max_connections_per_address)"
            return "too_many_from_address", limit
        return None

    def enter(self, address: str) -> None:
        """A connection from this address was let in."""
        self._inside[address] += 1

    def leave(self, address: str) -> None:
        """It has ended."""
        self._inside[address] -= 1
        if self._inside[address] <= 0:
            del self._inside[address]

    def closed_groups(self, address: str) -> frozenset[int]:
        """The groups that an agent with this address may not choose."""
        return frozenset(group for group, networks in self._groups.items() if not _is_in(address, networks))


Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def _networks(texts: Sequence[str]) -> list[Network]:
    return [ipaddress.ip_network(text, strict=False) for text in texts]


def _is_in(address: str, networks: Sequence[Network]) -> bool:
    try:
        host = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(host, ipaddress.IPv6Address) and host.ipv4_mapped is not None:
        host = host.ipv4_mapped
    return any(host in network for network in networks if network.version == host.version)
