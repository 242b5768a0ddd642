"""What the log says of links that come and go."""

from __future__ import annotations

import logging
from collections.abc import Mapping

log = logging.getLogger("macs.mesh")

SHORT = 8
"""Of a Zenoh id so much tells it from others."""


class LinkLog:
    """Names each link: a program has few, a router those of all its sessions."""

    def __init__(self, mode: str) -> None:
        self._mode = mode
        self._kinds: dict[str, str] = {}
        """What those are that there is a session with, by Zenoh id."""

    def changed(self, zid: str, up: bool, where: str, neighbours: Mapping[str, str], *, linked: bool) -> None:
        """A link with somebody at this endpoint came about or was lost; ``linked``: whether a router is left."""
        where = where.partition("?")[0].partition("#")[0]  # what follows are settings
        if self._mode == "client":
            what = "connected" if up else "lost" if linked else "lost; reconnecting"
            log.info("router %s %s (%s)", where, what, zid[:SHORT])
            return
        kind = neighbours.get(zid, "") if up else self._kinds.pop(zid, "")
        if up:
            self._kinds[zid] = kind
        level = logging.INFO if kind == "router" or self._mode == "router" else logging.DEBUG
        log.log(level, "%s %s at %s %s", kind or "session", zid[:SHORT], where, "is linked" if up else "has gone")
