"""Who did what at one gateway, for its audit file (docs/audit.md)."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from bridge.audit import NO_AUDIT, Audit, open_audit, who
from bridge.settings import GatewaySettings
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.agent_id import AgentId

from .connection import Connection


class Record:
    """Keeps nothing before `open`, and nothing without an audit file."""

    def __init__(self, losses: Losses) -> None:
        self._losses = losses
        self._audit: Audit = NO_AUDIT

    def open(self, settings: GatewaySettings, name: str) -> None:
        """Begin. Raises ConfigError when the file cannot be written."""
        self._audit = open_audit(
            settings.audit_file, name, settings.audit_max_bytes, settings.audit_files, self._not_whole
        )

    @property
    def is_kept(self) -> bool:
        """Whether there is an audit file."""
        return self._audit is not NO_AUDIT

    def agent(self, event: str, connection: Connection, what: str = "", result: str = "done") -> None:
        """An agent did something, or something was done to it."""
        if not self.is_kept:
            return
        by = who(str(AgentId(*connection.key)), connection.address, connection.peer.grant.name)
        self._audit.record(event, by, what, result)

    def address(self, event: str, address: str, what: str, result: str = "done") -> None:
        """Somebody did something of whom only the address is known."""
        self._audit.record(event, who(address=address), what, result)

    def token(self, event: str, name: str) -> None:
        """A token has changed."""
        self._audit.record(event, who(token=name))

    def other(self, event: str, by: Mapping[str, str], what: str, result: str) -> None:
        """Something else was done, or not: by whom, and what of it."""
        self._audit.record(event, by, what, result)

    def troubles(self) -> dict[str, int]:
        """What `macs doctor` shall find."""
        return self._audit.troubles()

    def close(self) -> None:
        """Write what waits; blocks for a second at the most."""
        self._audit.close()

    def _not_whole(self, name: str) -> None:
        level = logging.ERROR if name == "audit_lost" else logging.WARNING
        self._losses.once(name, "the record of who did what is not whole", level=level)
