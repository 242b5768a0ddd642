"""Who may connect: addresses, and how many of them. Pure."""

from __future__ import annotations

import ipaddress
from collections import Counter, OrderedDict
from collections.abc import Mapping, Sequence

STRANGERS_IN_ALL = 1024
STRANGERS_PER_ADDRESS = 256
"""Connections that have yet to show a token, where one is wanted: each has an id, which agents need."""


class Churn:
    """Connections that end soon, by address: each cost others the time in which it got an id, a presence and what it
    registered. Who makes many waits before the next is greeted, and others do not."""

    SOON_S = 2.0
    FREE = 100
    PER_S = 50.0
    MOST_S = 3.0
    """An existing headset waits for its greeting no longer than 5."""
    ADDRESSES = 4096

    def __init__(self) -> None:
        self._owed: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """How many, and when that was so; who owed last is at the end."""

    def ended(self, address: str, lived_s: float, now: float) -> None:
        """A connection that was greeted has ended."""
        if lived_s >= self.SOON_S:
            return
        self._owed[address] = (self._owes(address, now) + 1, now)
        self._owed.move_to_end(address)
        if len(self._owed) > self.ADDRESSES:
            self._owed.popitem(last=False)

    def wait_s(self, address: str, now: float) -> float:
        """How long the next connection from there is not greeted."""
        return min(self.MOST_S, max(0.0, self._owes(address, now) - self.FREE) / self.PER_S)

    def _owes(self, address: str, now: float) -> float:
        owed, at = self._owed.get(address, (0.0, now))
        return max(0.0, owed - (now - at) * self.PER_S)


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
        self._allow = networks(allow)
        self._groups = {int(group): networks(listed) for group, listed in (groups or {}).items()}
        self._max_connections = max_connections
        self._max_per_address = max_per_address
        self._inside: Counter[str] = Counter()
        self._in_all = 0
        self._strangers: Counter[str] = Counter()

    def judge(self, address: str, *, stranger: bool = False) -> tuple[str, str] | None:
        """Why a connection from this address is refused: the name of its counter, and a sentence; None lets it in.
        ``stranger``: it has yet to show a token."""
        if self._allow and not is_in(address, self._allow):
            return "address_not_allowed", "its address is not in gateway.allow"
        if self._in_all >= self._max_connections:
            return "too_many_connections", f"{self._max_connections} are connected (gateway.max_connections)"
        if self._inside[address] >= self._max_per_address:
            limit = f"{self._max_per_address} are connected from there (gateway.max_connections_per_address)"
            return "too_many_from_address", limit
        if stranger and (
            self._strangers[address] >= STRANGERS_PER_ADDRESS or self._strangers.total() >= STRANGERS_IN_ALL
        ):
            return "too_many_unknown", f"{self._strangers[address]} from there have yet to show a token"
        return None

    def enter(self, address: str, *, stranger: bool = False) -> None:
        """A connection from this address was let in."""
        self._inside[address] += 1
        self._in_all += 1
        if stranger:
            self._strangers[address] += 1

    def known(self, address: str) -> None:
        """One from this address is no stranger any more."""
        self._strangers[address] -= 1
        if self._strangers[address] <= 0:
            del self._strangers[address]

    def leave(self, address: str) -> None:
        """It has ended."""
        self._in_all -= 1
        self._inside[address] -= 1
        if self._inside[address] <= 0:
            del self._inside[address]

    def closed_groups(self, address: str) -> frozenset[int]:
        """The groups that an agent with this address may not choose."""
        return frozenset(group for group, within in self._groups.items() if not is_in(address, within))


Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def networks(texts: Sequence[str]) -> list[Network]:
    """Networks as settings name them."""
    return [ipaddress.ip_network(text, strict=False) for text in texts]


def is_in(address: str, within: Sequence[Network]) -> bool:
    """Whether an address is in one of these networks."""
    try:
        host = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(host, ipaddress.IPv6Address) and host.ipv4_mapped is not None:
        host = host.ipv4_mapped
    return any(host in network for network in within if network.version == host.version)
