"""What one TCP agent sends to robots: how much of it is passed on, and which commands have waited. Pure.

A robot drops what is too much for it, but on the way there it would fill the links that others' stops go over. And
only the gateway can see that commands waited in the agent's own connection: a headset whose Wi-Fi stood still for a
minute sends all that it said meanwhile at once, and no stamp tells how old it is. So after a gap none goes on that is
not known to be recent, by what the agent answered (`recency`), but for one that says to stand still (`halts`). Of one
that does not answer, or late, there is only the pace to go by: while commands come faster than they were ever said,
only the newest of each kind goes on, when no newer one has come for `TOGETHER_S`.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from enum import Enum

from .credit import Credit
from .halts import HALTS_PER_S
from .recency import Recency


class Passing(Enum):
    """What becomes of a frame."""

    NOW = "now"
    FLOODED = "flooded"
    """More than the agent may send."""
    WAITED = "waited"
    """It has waited, or may have: only the newest of its kind goes on, when none has come for `TOGETHER_S`."""
    TOO_OLD = "too old"
    """It may have been said long ago, and soon it will be known which is not."""


NOW, FLOODED, WAITED, TOO_OLD = Passing.NOW, Passing.FLOODED, Passing.WAITED, Passing.TOO_OLD

SINGLE_BYTES = 16 << 10
"""What is larger counts as several, for it is on the way of all others for as long."""


TOGETHER_S = 0.05
"""What has waited comes with smaller gaps than this, as far as they are not the network's."""


class Flow:
    """Commands of one kind: those to one interface node of the same robots."""

    LENGTH = 5
    """So many commands, each soon after the one before, are a flow: somebody drives."""
    LONG = 20
    """So many, and somebody drives for longer."""
    LEAST_S, MOST_S = 0.002, 0.5
    """What comes faster comes together, as programs send it that have several things to say; what comes slower is no
    flow."""
    GAP_S = 1.0
    """A flow that has a gap of so long has stood still, or somebody has stopped driving for a moment."""
    PAUSED_S = 3.0
    """Who has gone on for so long as before the gap had merely paused."""
    PACED = 3
    """So many in a row that come like the flow before the gap have not waited."""
    MEAN_OF = 16

    def __init__(self) -> None:
        self._last = -math.inf
        self._length = 0
        self._usual_s = 0.0
        """The mean gap between two commands."""
        self._late_since: float | None = None
        self._late = 0
        """How many came since."""
        self._most_late = 0.0
        """How many there can be that were said in the gap; since then more are said."""
        self._paced = 0

    @property
    def drives(self) -> bool:
        """Whether it is one: not a command now and then."""
        return self._length >= self.LENGTH or self._late_since is not None

    @property
    def is_long(self) -> bool:
        """Whether somebody drives for longer, and it pays to ask him (`recency`)."""
        return self._length >= self.LONG

    def has_waited(self, count: int, now: float) -> bool:
        """Whether commands that come at this time may be older than that."""
        gap, self._last = now - self._last, now
        if self._late_since is not None:
            return self._still_late(count, gap, now - self._late_since)
        if gap > self.GAP_S and self._length >= self.LENGTH:
            self._length, self._late_since, self._late, self._paced = 0, now, count, 0
            self._most_late = gap / max(self._usual_s, 1e-9) + 2
            return True
        if gap > self.MOST_S:
            self._length, self._usual_s = 0, 0.0
            return False
        each_s = gap / count
        self._usual_s += (each_s - self._usual_s) / self.MEAN_OF if self._usual_s else each_s
        if gap >= self.LEAST_S and count == 1:
            self._length += 1
        return False

    def _still_late(self, count: int, gap: float, late_s: float) -> bool:
        """A flow that has merely paused goes on as it was; what has waited comes as fast as the network takes it."""
        self._late += count
        said_since = late_s / max(self._usual_s, 1e-9)
        if self._late <= 1 + 2 * said_since:
            if late_s > self.PAUSED_S:
                self._late_since = None
            return False
        self._paced = self._paced + 1 if count == 1 and gap >= self._usual_s / 2 else 0
        if self._paced < self.PACED and self._late <= self._most_late + said_since:
            return True
        self._late_since = None
        return False


TOGETHER = 4
"""So many who send all the requests that one may are served by one gateway: more would fill the way of all others."""


def together(requests_per_s: float, now: float) -> Credit:
    """What all of a gateway may have together, of whom each may send so many requests. At once it is no more than one
    may send: of many who begin in the same moment everybody would hear the answers for a second."""
    return Credit(TOGETHER * requests_per_s, now, most=requests_per_s)


class Pace:
    """Of one connection. ``together`` is what all of a gateway may have; who sends little needs none of it."""

    LITTLE = 0.9
    """Who has as much of a second's requests left has sent little."""

    KINDS = 256
    """So many flows are known; of more than these the one that began first is forgotten."""

    NEW_KIND = 8
    """A command of a kind that is not known counts as so many: robots look for its node, and keep it for a moment."""

    DOUBT_S = 10.0
    """Who sends commands for so long, and no answer that proves any recent, is judged by its pace from then on."""

    def __init__(
        self, commands_per_s: float, requests_per_s: float, now: float, together: Credit | None = None
    ) -> None:
        self._commands = Credit(commands_per_s, now)
        self._requests = Credit(requests_per_s, now)
        self._halts = Credit(HALTS_PER_S, now)
        self._little = self.LITTLE * requests_per_s
        self._together = together
        self._flows: dict[Hashable, Flow] = {}
        self._last = -math.inf
        self._late_until = -math.inf
        """So long what is no flow counts as having waited, too: it came with what has."""
        self.recency = Recency()
        self._steady_since = -math.inf
        """Since when commands have come without a gap."""
        self._in_doubt = False
        self._doubted_s = 0.0
        """For how long commands have come that may be old."""
        self._answers_count = True

    def has_left(self, former: Pace) -> None:
        """It goes on for an agent that comes back, which has earned nothing by that: it has what it had left."""
        self._commands, self._requests, self._halts = former._commands, former._requests, former._halts

    def request(self, count: int, now: float, size: int = 0) -> Passing:
        """Of so many messages that are no commands, of ``size`` bytes together."""
        cost = _cost(count, size, self._requests)
        if not self._requests.take(cost, now):
            return FLOODED
        if self._together is None or self._requests.left(now) >= self._little:
            return NOW
        return NOW if self._together.take(cost, now) else FLOODED

    def command(self, kind: Hashable, count: int, now: float, size: int = 0) -> Passing:
        """Of so many commands of one kind, of ``size`` bytes, that came together; stops are not asked about."""
        flow = self._flows.get(kind)
        cost = _cost(count, size, self._commands, 1 if flow is not None else self.NEW_KIND)
        if not self._commands.take(cost, now):
            return FLOODED
        if flow is None:
            if len(self._flows) >= self.KINDS:
                del self._flows[next(iter(self._flows))]
            flow = self._flows[kind] = Flow()
        gap, self._last = now - self._last, now
        if gap > Flow.GAP_S:
            self._steady_since = now
            if self.drives:
                self._late_until = now + TOGETHER_S
        drives = flow.drives
        waited = flow.has_waited(count, now)
        if waited:
            self._late_until = now + TOGETHER_S
        if self._answers_count and self.recency.is_quick:
            return TOO_OLD if self._may_be_old(gap, now) else NOW
        return WAITED if waited or (not drives and now < self._late_until) else NOW

    def halt(self, now: float) -> bool:
        """Whether a command that says to stand still goes on, though there were too many before it."""
        return self._halts.take(1, now)

    @property
    def drives(self) -> bool:
        """Whether any of its commands are a flow."""
        return any(flow.drives for flow in self._flows.values())

    @property
    def drives_on(self) -> bool:
        """Whether one of these is a long one. Then it should be asked, every `Recency.EVERY_S`: programs that say a
        few things hear nothing that they did not hear before."""
        return any(flow.is_long for flow in self._flows.values())

    @property
    def in_doubt(self) -> bool:
        """Whether its commands do not go on until it has answered."""
        return self._in_doubt

    def answered(self, number: int, now: float) -> None:
        """It has answered a question; what comes from now on was said after that."""
        steady_since = math.inf if self._in_doubt or now - self._last > Flow.GAP_S else self._steady_since
        self.recency.answered(number, now, steady_since)
        if self.recency.age_at_most(now) <= self.recency.RECENT_S:
            self._in_doubt = False

    def _may_be_old(self, gap: float, now: float) -> bool:
        """Whether commands that come after such a gap may have been said long before. With the gap doubt begins,
        unless they are known to be recent; it ends with an answer."""
        if not self._in_doubt:
            self._in_doubt = gap > Flow.GAP_S and self.recency.age_at_most(now) > self.recency.RECENT_S
            self._doubted_s = 0.0
            return self._in_doubt
        self._doubted_s += min(gap, Flow.GAP_S)
        if self._doubted_s > self.DOUBT_S:
            self._answers_count = self._in_doubt = False
        return self._in_doubt


def _cost(count: int, size: int, credit: Credit, least: int = 1) -> float:
    """What messages take of it: one each, or as many as they are large. Never more than half a second's worth, so that
    the largest passes as well."""
    return max(count, min(max(-(-size // SINGLE_BYTES), least), credit.frames_per_s / 2))
