"""What is noted: an event, who, what, and the result. Pure; the file is another matter."""

from __future__ import annotations

import ipaddress
from collections import OrderedDict
from collections.abc import Mapping
from typing import Protocol

TEXT = 400
"""Characters of one text: names come from the network."""


FEW = frozenset(
    {"started", "stopped", "stop", "release", "recording", "rights_changed", "token_ended"}
    | {f"token_{what}" for what in ("created", "changed", "removed", "paired")}
)
"""Of these each is noted that was done."""
BEFORE = "it was stopped before"
"""The result of a stop of somebody else's, whose press counts as well."""


class Shares:
    """How many lines each may have, and all together: who does, or tries, the same thing all day would push what was
    done out of the record, by one name or by many that he makes up. Pure."""

    AT_ONCE = 4000
    """More than come of all connections that one address may have, when they end together."""
    PER_S = 20.0
    ALL_AT_ONCE = 16 * AT_ONCE
    """Half of it for what was refused: that costs who tries nothing."""
    ALL_PER_S = 2 * PER_S
    KNOWN = 4096

    def __init__(self) -> None:
        self._of: OrderedDict[str, tuple[float, float, int]] = OrderedDict()
        """By who: how many he has had lately, when that was so, and how many were left out since his last one."""
        self._all = 0.0, 0.0
        """How many all have had lately, and when that was so."""

    def take(self, event: str, by: Mapping[str, str], result: str, now: float) -> int | None:
        """How many lines of his were left out before this one; None: this one is as well."""
        if event in FEW and result in ("done", BEFORE):
            return 0
        who = _host(by.get("address", "")) or by.get("agent") or by.get("token", "")
        known = self._of.pop(who, None)
        if known is None and len(self._of) >= self.KNOWN:  # a new name gives nobody more than he had by another
            had, at, _ = self._of.popitem(last=False)[1]
            known = had, at, 0
        had, at, left_out = known or (0.0, now, 0)
        had = max(0.0, had - self.PER_S * (now - at))
        all_had, all_at = self._all
        all_had = max(0.0, all_had - self.ALL_PER_S * (now - all_at))
        most = self.ALL_AT_ONCE if result == "done" else self.ALL_AT_ONCE / 2
        noted = had + 1 <= self.AT_ONCE and all_had + 1 <= most
        self._of[who] = had + noted, now, 0 if noted else left_out + 1
        self._all = all_had + noted, now
        return left_out if noted else None


def _host(address: str) -> str:
    """Without the port, which is another one each time; of IPv6 the network, of which one host has every address."""
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit() and (":" not in host or host.endswith("]"))):
        host = address
    if ":" not in host:
        return host
    try:
        there = ipaddress.IPv6Address(host.strip("[]"))
    except ValueError:
        return host
    if there.is_link_local or there.is_loopback:  # which all have in common
        return host
    return str(ipaddress.IPv6Network((int(there), 64), strict=False))


class Audit(Protocol):
    """Takes notes, from any thread, at once."""

    def record(self, event: str, by: Mapping[str, str], what: str = "", result: str = "done") -> None:
        """``event`` is a word, as joined; ``by`` says `who`; ``result`` is ``done``, or why it was not."""

    def troubles(self) -> dict[str, int]:
        """What `macs doctor` shall find: how many lines wait for a file that cannot be written."""

    def close(self) -> None:
        """Write what waits, and the last line."""


class _NoAudit:
    """There is no ``audit_file``."""

    def record(self, event: str, by: Mapping[str, str], what: str = "", result: str = "done") -> None:
        pass

    def troubles(self) -> dict[str, int]:
        return {}

    def close(self) -> None:
        pass


NO_AUDIT: Audit = _NoAudit()


def who(agent: str = "", address: str = "", token: str = "") -> dict[str, str]:
    """Who did it, with what is known of him."""
    known = {"agent": agent, "address": address, "token": token}
    return {name: text[:TEXT] for name, text in known.items() if text}
