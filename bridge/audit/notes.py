"""What is noted: an event, who, what, and the result. Pure; the file is another matter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

TEXT = 400
"""Characters of one text: names come from the network."""


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
