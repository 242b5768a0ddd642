"""Latched topics: each registrant gets what its publishers hold for late ones, once, whenever it registers.

A ROS subscription gets a transient local topic's last messages when it is made, and never again. So for registrants
that come to a subscription that exists, another one is made, for a moment; what it gets goes to those that have not
had it. ROS does not tell whose a message is, but no two have both the time and the number that their publisher gave.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from msgspec import structs

from bridge.ros import qos
from bridge.ros.interface import Registrant
from bridge.ros.side import Closable, Events, OnRaw, Side
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos

Receivers = frozenset[tuple[int, int]]
"""Registrants, as (agent type, agent id)."""
Message = tuple[Any, Any]
"""A message by its publisher's time and number."""


def message_of(info: Mapping[str, Any]) -> Message:
    """Which message it is, by what ROS knows about it."""
    return info["source_timestamp"], info["publication_sequence_number"]


class Told:
    """Who has had which message. Pure; from any thread."""

    KEPT = 1024
    """So many messages are remembered, more than any publisher that latches is likely to hold."""

    def __init__(self) -> None:
        self._told: dict[Message, Receivers] = {}
        self._lock = threading.Lock()

    def to_tell(self, message: Message, registrants: Receivers) -> Receivers:
        """Those of them that have not had it; from now on they have."""
        with self._lock:
            before = self._told.pop(message, None)
            if before is None:
                if len(self._told) >= self.KEPT:
                    del self._told[next(iter(self._told))]
                self._told[message] = registrants
                return registrants
            self._told[message] = before | registrants
            return registrants - before

    def forget(self, registrant: Registrant) -> None:
        """It left; when it is back it has had nothing."""
        with self._lock:
            for message, told in self._told.items():
                if registrant in told:
                    self._told[message] = told - {registrant}


class Newcomers:
    """Those that registered on a topic after its subscription was made, and what its publishers hold for them."""

    QUIET_S = 3.0
    """A subscription for them ends so long after the last thing that it got: a big map takes its time."""
    LOOK_S = 0.5
    AT_ONCE = 8
    """Subscriptions for them that there are: who comes meanwhile waits for the end of one, together with others. A
    headset can register and take that back without end."""

    def __init__(
        self,
        session: Side,
        subscribe: Callable[[Qos, OnRaw, Events | None], Closable],
        publishers: Callable[[], list[Qos]],
        profile: Callable[[Iterable[Qos]], Qos],
        tell: Callable[[bytes, Mapping[str, Any], Receivers], bool],
    ) -> None:
        """``subscribe`` with a profile, a callback and events; ``publishers`` gives the profiles of the topic's;
        ``tell`` takes a message and who may want it, and says whether anybody did."""
        self._session = session
        self._subscribe = subscribe
        self._publishers = publishers
        self._profile = profile
        self._tell = tell
        self._waiting: set[tuple[int, int]] = set()
        self._lock = threading.Lock()
        self._open: list[_Catching] = []

    def welcome(self, registrants: Iterable[tuple[int, int]]) -> None:
        """Give them what is held for late ones. From any thread."""
        with self._lock:
            asked = bool(self._waiting)
            self._waiting.update(registrants)
        if not asked:  # one subscription for all that come in the same moment
            self._session.submit(self._catch_up)

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def close(self) -> None:
        """End the subscriptions."""
        with self._lock:
            self._waiting.clear()
        for catching in list(self._open):
            self._end(catching)

    def _catch_up(self) -> None:
        if len(self._open) >= self.AT_ONCE:
            return  # `_end` goes on
        with self._lock:
            waiting, self._waiting = frozenset(self._waiting), set()
        latching = [offered for offered in self._publishers() if qos.is_latched(offered)]
        if not latching or not waiting:
            return
        catching = _Catching(waiting, self._tell)
        profile = structs.replace(self._profile(latching), durability=Durability.TRANSIENT_LOCAL)
        catching.subscription = self._subscribe(profile, catching.take, Events(matched=catching.matched))
        self._open.append(catching)
        self._session.later(self.LOOK_S, lambda: self._look(catching, 0.0))

    def _look(self, catching: _Catching, quiet_s: float) -> None:
        if catching not in self._open:
            return
        busy, catching.busy = catching.busy, False
        quiet_s = 0.0 if busy else quiet_s + self.LOOK_S
        if quiet_s >= self.QUIET_S:
            self._end(catching)
        else:
            self._session.later(self.LOOK_S, lambda: self._look(catching, quiet_s))

    def _end(self, catching: _Catching) -> None:
        self._open.remove(catching)
        if catching.subscription is not None:
            catching.subscription.close()
        if self._waiting:
            self._session.submit(self._catch_up)


class _Catching:
    """A subscription for some newcomers; its callbacks are called in the thread of the intake."""

    MESSAGES = 1000
    """On a busy topic each message may come here first; after so many it is no latched one that is waited for."""

    def __init__(
        self,
        newcomers: Receivers,
        tell: Callable[[bytes, Mapping[str, Any], Receivers], bool],
    ) -> None:
        self._newcomers = newcomers
        self._tell = tell
        self._left = self.MESSAGES
        self.subscription: Closable | None = None
        self.busy = True

    def matched(self, _count: int, _change: int) -> None:
        self.busy = True

    def take(self, cdr: bytes, info: Mapping[str, Any]) -> None:
        if self._tell(cdr, info, self._newcomers):
            self._left -= 1
            self.busy = self._left > 0
