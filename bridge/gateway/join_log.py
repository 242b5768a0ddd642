"""The log of who comes: a line for each, and where many come at once one for all who come behind the first."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable, Iterator
from itertools import pairwise

from macs_zenoh.protocol.keyexpr import type_name

from .connection import Connection

log = logging.getLogger("macs.gateway")

SINGLY = 20
WITHIN_S = 1.0
"""So many within this time have a line each: a line takes a tenth of what a joining agent costs."""

ADDRESSES = 3
"""So many are named of where they come from."""


class JoinLog:
    """That of one gateway."""

    def __init__(self) -> None:
        self._said = 0
        self._more: list[tuple[int, int, str]] = []
        """Type, id and host of those who have no line."""
        self._timer: asyncio.TimerHandle | None = None

    def joined(self, connection: Connection) -> None:
        """An agent is online."""
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(WITHIN_S, self._say)
        if self._said < SINGLY:
            self._said += 1
            peer = connection.peer
            group = f" in group {peer.group}" if peer.group else ""
            token = f" with token {peer.grant.name}" if peer.grant.name else ""
            log.info("%s is online%s%s", connection, group, token)
        else:
            self._more.append((*connection.key, connection.host))

    def close(self) -> None:
        """Say what is left to be said."""
        if self._timer is not None:
            self._timer.cancel()
            self._say()

    def _say(self) -> None:
        self._timer, self._said = None, 0
        more, self._more = self._more, []
        if not more:
            return
        hosts = sorted({host for _, _, host in more})
        rest = f" and {len(hosts) - ADDRESSES} more" if len(hosts) > ADDRESSES else ""
        log.info("%d more are online: %s at %s%s", len(more), _named(more), ", ".join(hosts[:ADDRESSES]), rest)


def _named(more: Iterable[tuple[int, int, str]]) -> str:
    """Who they are: ``unity/3-250, unity/252``."""
    ids: dict[int, list[int]] = {}
    for kind, agent_id, _ in more:
        ids.setdefault(kind, []).append(agent_id)
    return ", ".join(f"{type_name(kind)}/{one}" for kind in sorted(ids) for one in _ranges(sorted(ids[kind])))


def _ranges(ids: list[int]) -> Iterator[str]:
    """Numbers in their order, those that follow each other as one."""
    begin = ids[0]
    for one, following in pairwise([*ids, -1]):
        if following != one + 1:
            yield f"{begin}-{one}" if one > begin else str(one)
            begin = following
