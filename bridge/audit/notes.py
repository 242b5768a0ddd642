"""What is noted: an event, who, what, and the result. Pure; the file is another matter."""

from __future__ import annotations

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


class Shares:
    """How many lines each may have: who does, or tries, the same thing all day would push what was done out of the
    record. Pure."""

    AT_ONCE = 4000
    """More than come of all connections that one address may have, when they end together."""
    PER_S = 20.0
    KNOWN = 4096

    def __init__(self) -> None:
        self._of: OrderedDict[str, tuple[float, float, int]] = OrderedDict()
        """By who: how many he has had lately, when that was so, and how many were left out since his last one."""

    def take(self, event: str, by: Mapping[str, str], result: str, now: float) -> int | None:
        """How many lines of his were left out before this one; None: this one is as well."""
        if event in FEW and result == "done":
            return 0
        who = _host(by.get("address", "")) or by.get("agent") or by.get("token", "")
        known = self._of.pop(who, None)
        if known is None:  # names that somebody makes up give him no more
            known = self._of.popitem(last=False)[1] if len(self._of) >= self.KNOWN else (0.0, now, 0)
        had, at, left_out = known
        had = max(0.0, had - self.PER_S * (now - at))
        if had + 1 > self.AT_ONCE:
            self._of[who] = had, now, left_out + 1
            return None
        self._of[who] = had + 1, now, 0
        return left_out


def _host(address: str) -> str:
    """Without the port, which is another one each time."""
    host, _, port = address.rpartition(":")
    return host if host and port.isdigit() and (":" not in host or host.endswith("]")) else address


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
