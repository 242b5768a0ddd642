"""What routers tell of themselves, and how long each link takes there and back: the time to its far end, less that to
its near one. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping

import msgspec

from .directory import published
from .limits import ROUTER_BYTES

KEPT = 5
"""Of so many last round trips the least counts: what came on top of it was a wait, and of nobody's link."""


class RouterLink(msgspec.Struct, frozen=True):
    """A link of such a session."""

    dst: str = ""


class RouterSession(msgspec.Struct, frozen=True):
    """Somebody whom a router has a session with."""

    peer: str = ""
    whatami: str = ""
    shm: bool | None = None
    links: list[RouterLink | str] = []
    """Zenoh 1.0 writes the far end alone."""

    @property
    def address(self) -> str:
        """The far end of its first link; empty where nothing is said of it."""
        link = next(iter(self.links), "")
        return link if isinstance(link, str) else link.dst


class Router(msgspec.Struct, frozen=True):
    """A router, as its admin space has it."""

    zid: str
    version: str = ""
    locators: list[str] = []
    sessions: list[RouterSession] = []

    @property
    def linked(self) -> list[str]:
        """Ids of the routers that it is linked with itself."""
        return sorted({session.peer for session in self.sessions if session.whatami == "router"})

    @property
    def behind(self) -> frozenset[str]:
        """Sessions that it has, as they are `published`."""
        return frozenset(published(session.peer) for session in self.sessions if session.whatami != "router")

    @property
    def release(self) -> str:
        """``1.10.2`` of ``v1.10.2-release built with rustc …``."""
        return self.version.partition(" ")[0].partition("-")[0].removeprefix("v")


def router_of(answer: bytes) -> Router | None:
    """What a router tells of itself; None where that makes no sense: others may answer as well."""
    if len(answer) > ROUTER_BYTES:
        return None
    try:
        return msgspec.json.decode(answer, type=Router)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None


class Trips:
    """Round trips by somebody's session, of which the least of the last few counts."""

    def __init__(self) -> None:
        self._last: dict[str, deque[float]] = {}

    def note(self, zid: str, took_s: float) -> None:
        """It took so long this time."""
        self._last.setdefault(zid, deque(maxlen=KEPT)).append(took_s)

    def of(self, zid: str) -> float | None:
        """None: nobody knows."""
        last = self._last.get(zid)
        return min(last) if last else None

    def keep(self, zids: Collection[str]) -> None:
        """Forget all others."""
        for gone in self._last.keys() - set(zids):
            del self._last[gone]


def between(
    routers: Mapping[str, Collection[str]], own: Collection[str], trips: Trips
) -> dict[tuple[str, str], float]:
    """The round trip of each link between two routers, by their ids in either order; ``own`` are those that we are
    linked with. Of two that are as far away as each other nobody here can tell."""
    steps = dict.fromkeys(own, 0)
    waiting = deque(own)
    while waiting:
        here = waiting.popleft()
        for other in routers.get(here, ()):
            if other not in steps:
                steps[other] = steps[here] + 1
                waiting.append(other)
    found = {}
    for here, linked in routers.items():
        for other in linked:
            near, far = trips.of(here), trips.of(other)
            if near is None or far is None or far < near:  # the last: both are too uncertain
                continue
            if steps.get(other, 0) == steps.get(here, 0) + 1:
                found[here, other] = found[other, here] = far - near
    return found
