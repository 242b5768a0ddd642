"""How old the commands are of senders that tell when they made them. Pure.

Such a sender names a clock of its own, and the request id of each command is the time on it, in ticks of 0.1 ms, which
only rises (docs/protocol.md). Nobody compares clocks, nor believes them: the robot asks what time it is there. What
the answer names was read after the question was put, so a command was made no earlier than that plus the difference
of the two times on the sender's clock. What took long on the way, in whichever direction, makes commands older by this
bound and never younger; an answer that comes late says as much as one that comes soon.
"""

from __future__ import annotations

import math
import secrets
import threading
from collections import OrderedDict, deque
from collections.abc import Collection
from itertools import islice
from typing import NamedTuple

from .messages import CommandClock, Metadata

TICK_S = 1e-4
DRIFT = 5e-4
"""Two clocks may differ by as much of the time that has passed since they were compared."""
AHEAD_S = 0.05
"""A command that was made later than now by more than this is none of the clock that was asked."""


class Refusal(NamedTuple):
    """Why a command is not carried out; ``kind`` is the name under which that is counted."""

    kind: str
    reason: str


class Verdict(NamedTuple):
    """What is known of a command: ``age_s`` is how old it is at most, 0 where nothing is known."""

    refusal: Refusal | None = None
    age_s: float = 0.0


FINE = Verdict()

NO_CLOCK = "no_clock"
_UNKNOWN = Refusal(NO_CLOCK, "it tells a time on a clock that this robot has not been answered by: say hello first")
_UNTOLD = Refusal(NO_CLOCK, "its sender tells the time of its commands, and this one has none")
_REPEATED = Refusal("repeated", "this very command was carried out before")
_DISORDERED = Refusal("out_of_order", "a command that was made later was carried out before")


class _Newest:
    """Of one interface node: the commands that were carried out last."""

    LAST = 64

    __slots__ = ("_last", "time")

    def __init__(self, time: int) -> None:
        self.time = time
        self._last: deque[int] = deque(maxlen=self.LAST)

    def problem(self, time: int) -> Refusal | None:
        if time > self.time:
            return None
        return _REPEATED if time in self._last else _DISORDERED

    def note(self, time: int) -> None:
        self.time = time
        self._last.append(time)


class _Clock:
    """A sender's clock."""

    NODES = 64
    OPEN = 8

    def __init__(self, name: str) -> None:
        self.name = name
        self.wanted_at = self.asked_at = self.answered_at = self.commanded_at = -math.inf
        self._least = 0.0
        """Time here when it was 0 there, at least; as of ``_compared_at``."""
        self._compared_at = -math.inf
        self._floor = 0
        """What was made before is not carried out, whatever node it is for: nobody knows whether it was."""
        self._open: OrderedDict[int, float] = OrderedDict()
        self._newest: OrderedDict[str, _Newest] = OrderedDict()

    @property
    def compared(self) -> bool:
        return self._compared_at > -math.inf

    def forget(self) -> None:
        """It is another clock than it was."""
        self._compared_at = self.answered_at = -math.inf

    def question(self, now: float) -> int:
        number = secrets.randbits(52) | 1
        self._open[number] = self.asked_at = now
        if len(self._open) > self.OPEN:
            self._open.popitem(last=False)
        return number

    def asked(self, number: int) -> bool:
        """Whether that was asked, and has not been answered."""
        return number in self._open

    def answer(self, number: int, time: int, now: float) -> bool:
        """Whether that was asked. Each question counts once: a repeated answer says nothing."""
        asked_at = self._open.pop(number, None)
        if asked_at is None:
            return False
        self.answered_at = now
        if not self.compared:
            self._floor = time
        least = asked_at - time * TICK_S
        zero = self._zero_at(now) if self.compared else -math.inf
        was_set = now - time * TICK_S < zero  # it is later there than it can be by the answers before
        if least >= zero or was_set:
            self._least, self._compared_at = least, now
        return True

    def age_at_most(self, time: int, now: float) -> float:
        return now - self._zero_at(now) - time * TICK_S

    def _zero_at(self, now: float) -> float:
        return self._least - DRIFT * (now - self._compared_at)

    def newest(self, node: str) -> _Newest:
        newest = self._newest.get(node)
        if newest is None:
            newest = self._newest[node] = _Newest(self._floor)
            if len(self._newest) > self.NODES:
                self._floor = max(self._floor, self._newest.popitem(last=False)[1].time)
        else:
            self._newest.move_to_end(node)
        return newest


class CommandClocks:
    """Those of all senders of one robot. From any thread. ``max_age_s`` 0: of any age, but neither repeated nor out of
    order."""

    SENDERS = 1024
    """So many that have answered are kept, and as many that have not. Whoever commands is never displaced."""
    COMMANDS_S = 5.0
    """So long after a command that was carried out a sender counts as one that commands."""
    EVERY_S = 1.0
    """So often a sender is asked."""
    LOOKED_AT = 64
    """At most so many are asked at one time of those that command, and as many of all, each in turn: names that
    somebody makes up must not take the time of commands."""
    WANTED_S = 60.0
    """So long after its last command or hello."""
    ANSWERED_S = 5.0
    """A clock that has not answered for so long is not known any more."""

    def __init__(self, max_age_s: float) -> None:
        self.max_age_s = max_age_s
        self._clocks: OrderedDict[str, _Clock] = OrderedDict()
        """By sender; who has not commanded for longest comes first."""
        self._others: OrderedDict[str, _Clock] = OrderedDict()
        """A clock that a sender names and that has not answered: until it has, the one before it counts."""
        self._commanding: OrderedDict[str, None] = OrderedDict()
        """Who has commanded and is to be asked: before all others."""
        self._turn: deque[str] = deque()
        """Who is looked at next."""
        self._lock = threading.Lock()

    def hello(self, sender: str, name: str, now: float) -> CommandClock:
        """A sender means to command by this clock: what to ask it now."""
        with self._lock:
            clock = self._meet(sender, name)
            clock.wanted_at = now
            return self._question(clock, now)

    def answered(self, sender: str, said: CommandClock, now: float) -> CommandClock | None:
        """A sender has answered: what to tell it, if its clock has become known by that."""
        with self._lock:
            clock = self._find(sender, said.clock)
            if clock is None or not isinstance(said.at, int) or not clock.asked(said.question):
                return None
            is_new = self._others.get(sender) is clock
            if is_new and not self._has_place(sender, now):
                return None
            known = self._known(clock, now)
            clock.answer(said.question, said.at, now)
            if is_new:
                del self._others[sender]
                self._clocks[sender] = clock
            return None if known else CommandClock(clock=clock.name, known=True, max_age_s=self.max_age_s)

    def due(self, now: float) -> list[tuple[str, CommandClock]]:
        """Whom to ask now, and what. A command waits for no more than one of them."""
        return [(sender, question) for sender in self._looked_at() for question in self._questions(sender, now)]

    def _looked_at(self) -> list[str]:
        with self._lock:
            if not self._turn:
                self._turn.extend(self._clocks)
                self._turn.extend(self._others)
            first = [self._commanding.popitem(last=False)[0] for _ in self._few(self._commanding)]
            return first + [self._turn.popleft() for _ in self._few(self._turn)]

    def _few(self, of: Collection[str]) -> range:
        return range(min(self.LOOKED_AT, len(of)))

    def _questions(self, sender: str, now: float) -> list[CommandClock]:
        """What to ask one of them; who has not been wanted for long is forgotten."""
        due = []
        with self._lock:
            for clocks in (self._clocks, self._others):
                clock = clocks.get(sender)
                if clock is None:
                    continue
                if now - clock.wanted_at > self.WANTED_S:
                    if not self._known(clock, now):
                        del clocks[sender]
                elif now - clock.asked_at >= self.EVERY_S:
                    due.append(self._question(clock, now))
        return due

    def _has_place(self, sender: str, now: float) -> bool:
        """Whether one more that has answered can be kept; for it goes who has not commanded for longest."""
        if sender in self._clocks or len(self._clocks) < self.SENDERS:
            return True
        for first in list(islice(self._clocks, self.LOOKED_AT)):
            if now - self._clocks[first].commanded_at > self.COMMANDS_S:
                del self._clocks[first]
                return True
            self._clocks.move_to_end(first)
        return False

    @property
    def wanted(self) -> bool:
        """Whether anybody tells the time."""
        return bool(self._clocks or self._others)

    def left(self, sender: str) -> None:
        """Whoever has this name next has another clock."""
        with self._lock:
            self._clocks.pop(sender, None)
            self._others.pop(sender, None)

    def judge(self, sender: str, metadata: Metadata, now: float, *, halts: bool = False) -> Verdict:
        """Whether a command is carried out. What ``halts`` is in any case, and what was made before it is not then."""
        if not metadata.clock and not self._clocks:
            return FINE
        with self._lock:
            verdict = self._judge(sender, metadata, now, halts)
        return Verdict(None, max(0.0, verdict.age_s)) if halts else verdict

    def _judge(self, sender: str, metadata: Metadata, now: float, halts: bool) -> Verdict:
        known = self._clocks.get(sender)
        name = metadata.clock
        if not name:
            told = known is not None and self._known(known, now)
            return Verdict(_UNTOLD) if told else FINE
        clock = self._meet(sender, name)
        clock.wanted_at = now
        if now - clock.asked_at >= self.EVERY_S and len(self._commanding) < self.SENDERS:
            self._commanding[sender] = None
        if clock is not known or not self._known(clock, now):
            return Verdict(_UNKNOWN)
        time = metadata.request_id
        age_s = clock.age_at_most(time, now)
        if age_s < -AHEAD_S:
            clock.forget()
            return Verdict(_UNKNOWN)
        newest = clock.newest(metadata.node_name)
        problem = newest.problem(time)
        if problem is None and not halts and 0 < self.max_age_s < age_s:
            problem = Refusal("too_old", f"it may be {age_s:.2f} s old, more than {self.max_age_s:g} s")
        if problem is None:
            newest.note(time)
            clock.commanded_at = now
            self._clocks.move_to_end(sender)
        return Verdict(problem, max(0.0, age_s))

    def _known(self, clock: _Clock, now: float) -> bool:
        return clock.compared and now - clock.answered_at <= self.ANSWERED_S

    def _question(self, clock: _Clock, now: float) -> CommandClock:
        known = self._known(clock, now)
        return CommandClock(clock=clock.name, question=clock.question(now), known=known, max_age_s=self.max_age_s)

    def _find(self, sender: str, name: str) -> _Clock | None:
        for clocks in (self._clocks, self._others):
            clock = clocks.get(sender)
            if clock is not None and clock.name == name:
                return clock
        return None

    def _meet(self, sender: str, name: str) -> _Clock:
        clock = self._find(sender, name)
        if clock is None:
            clock = self._others[sender] = _Clock(name)
            self._others.move_to_end(sender)
            if len(self._others) > self.SENDERS:
                self._others.popitem(last=False)
        return clock
