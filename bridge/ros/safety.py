"""What makes a robot safe to teleoperate: who commands a topic, what happens when commands stop, the emergency stop.

Pure: the time is passed in, in seconds. Agents are whatever identifies them.
"""

from __future__ import annotations

import math
import threading
import uuid
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field


class Control:
    """Who may command a topic for which only one agent may. The first command takes it.

    It is free again ``hold_s`` after the holder's last command, and at once when the holder gives it up or leaves. The
    holder can hand it to another agent, which then has ``hold_s`` to begin.
    """

    def __init__(self, hold_s: float) -> None:
        self.hold_s = hold_s
        self._holder: Hashable | None = None
        self._since = -math.inf
        self._until = -math.inf
        self.on_taken: Callable[[Hashable], None] = lambda agent: None
        """Is told who has taken control that was free."""

    def holder(self, now: float) -> Hashable | None:
        """Who has control; None while it is free."""
        return self._holder if now < self._until else None

    def seconds_left(self, now: float) -> float:
        """How long the holder keeps it without a further command."""
        return max(0.0, self._until - now) if self._holder is not None else 0.0

    def seconds_held(self, now: float) -> float:
        """How long the holder has had it."""
        return now - self._since if self.holder(now) is not None else 0.0

    def take(self, agent: Hashable, now: float) -> bool:
        """Have or keep control; every command does. False when somebody else has it."""
        holder = self.holder(now)
        if holder not in (None, agent):
            return False
        self._holder, self._until = agent, now + self.hold_s
        if holder is None:
            self._since = now
            self.on_taken(agent)
        return True

    def give(self, agent: Hashable, to: Hashable, now: float) -> bool:
        """Hand control over. False when ``agent`` does not have it."""
        if self.holder(now) != agent:
            return False
        self._holder, self._since, self._until = to, now, now + self.hold_s
        return True

    def release(self, agent: Hashable) -> bool:
        """Give control up. False when ``agent`` does not have it."""
        if self._holder != agent:
            return False
        self._holder, self._until = None, -math.inf
        return True


class DeadMan:
    """Notices that commands have stopped, once per stop.

    Armed by a command, it trips when ``silence_s`` have passed without a further one, or when the agent of the last
    command leaves. ``silence_s`` None: only the latter.
    """

    def __init__(self, silence_s: float | None) -> None:
        self.silence_s = silence_s
        self.trips = 0
        self.why = ""
        self.on_trip: Callable[[str], None] = lambda why: None
        self._commander: Hashable | None = None
        self._last = -math.inf

    @property
    def commander(self) -> Hashable | None:
        """Whose command was the last, while it is armed."""
        return self._commander

    def command(self, agent: Hashable, sent: float) -> None:
        """A command was published that was sent then: one that waited on its way says no more than that somebody
        commanded when it was sent."""
        self._commander, self._last = agent, max(self._last, sent)

    def deadline(self) -> float | None:
        """When it trips unless a command comes; None while it cannot."""
        if self._commander is None or self.silence_s is None:
            return None
        return self._last + self.silence_s

    def tick(self, now: float) -> bool:
        """Whether it trips now."""
        deadline = self.deadline()
        return deadline is not None and now >= deadline and self._trip(f"no command for {self.silence_s:g} s")

    def left(self, agent: Hashable, how: str = "left") -> bool:
        """An agent is gone, or its connection is. Whether it trips."""
        return self._commander is not None and self._commander == agent and self._trip(f"{agent} {how}")

    def disarm(self, why: str) -> bool:
        """Somebody else stops the robot. Whether commands were under way."""
        return self._commander is not None and self._trip(why)

    def _trip(self, why: str) -> bool:
        self._commander = None
        self.trips += 1
        self.why = why
        self.on_trip(why)
        return True


class Trips:
    """How often the dead-man of each topic has acted, and why the last time: also of those whose node has gone, as
    when who commanded has left. From any thread."""

    MOST = 256

    def __init__(self) -> None:
        self._of: dict[str, tuple[int, str]] = {}
        self._lock = threading.Lock()

    def note(self, topic: str, why: str) -> None:
        """One has acted."""
        with self._lock:
            times, _ = self._of.pop(topic, (0, ""))
            self._of[topic] = times + 1, why
            if len(self._of) > self.MOST:
                del self._of[next(iter(self._of))]

    def all(self) -> dict[str, tuple[int, str]]:
        """By topic, those that have."""
        with self._lock:
            return dict(self._of)


@dataclass
class EmergencyStop:
    """Latched: once stopped, stopped until released. Whoever stopped can take that back; the robot goes on when nobody
    is left who stopped it.

    Several programs may keep one stop among them (`adopt`): each change has a number, and the highest wins, but for
    presses that whoever has that number did not know. So each program says which presses were made where it is, with
    their numbers, and up to which number of each other program it knows.
    """

    stopped: bool = False
    pressed: list[str] = field(default_factory=list)
    """Everybody who stopped it and has not taken that back, the first first."""
    by: str = ""
    """Who stopped it; who released it, when it is not stopped."""
    since: float = 0.0
    """Seconds since the epoch."""
    times: int = 0
    presses: int = 0
    """How often somebody stopped it who had not before, or not within `COPIES_S`: whoever releases it says up to which
    he knows."""
    changes: int = 0
    """The number of the last change, here or elsewhere."""
    history: list[str] = field(default_factory=list)
    session: str = field(default_factory=lambda: uuid.uuid4().hex)
    """Which of the programs this is."""
    own: dict[str, int] = field(default_factory=dict)
    """Who stopped it here and has not taken that back, and the number of that change."""
    heard: dict[str, int] = field(default_factory=dict)
    """By session: up to which number its presses are known in what `pressed` says now."""
    counted: dict[str, float] = field(default_factory=dict)
    """When each of those who stopped it here was counted last."""

    HISTORY = 20
    PRESSED = 64
    """More are not remembered: the robot is stopped, and their releases do not count."""
    COPIES_S = 1.0
    """One press comes as data and as a call, and is said again for so long: that counts once."""
    HEARD = 64
    """Sessions that are remembered."""

    def press(self, by: str, now: float) -> bool:
        """Stop. Whether this is new."""
        was = self.stopped
        if by not in self.pressed and len(self.pressed) < self.PRESSED:
            self.changes += 1
            self.own[by] = self.changes
            self._become([*self.pressed, by], by, now)
            self.counted[by] = now
        elif by in self.pressed and abs(now - self.counted.get(by, -math.inf)) > self.COPIES_S:
            self.changes += 1  # who has released it elsewhere did not know this one
            self.own[by] = self.changes
            self.presses += 1
            self.counted[by] = now
        return not was

    def take_back(self, by: str, now: float) -> bool:
        """One of those who stopped it stops it no more. Whether the robot goes on by that."""
        if by not in self.pressed:
            return False
        self.changes += 1
        self._become([agent for agent in self.pressed if agent != by], by, now)
        return not self.stopped

    def release(self, by: str, now: float) -> bool:
        """Go on, whoever stopped it. Whether this is new."""
        if not self.stopped:
            return False
        self.changes += 1
        self._become([], by, now)
        return True

    def left(self, agent: str) -> None:
        """An agent is gone; who comes under its name is another, and cannot take back what this one did."""
        self.pressed = [f"{agent} (left)" if pressed == agent else pressed for pressed in self.pressed]
        if agent in self.own:
            self.own[f"{agent} (left)"] = self.own.pop(agent)

    def adopt(
        self,
        changes: int,
        pressed: list[str],
        by: str,
        now: float,
        *,
        session: str = "",
        own: Mapping[str, int] | None = None,
        heard: Mapping[str, int] | None = None,
    ) -> bool:
        """What another program says of the same stop. Whether that changed anything here. Of two that changed it at
        once, who stopped wins. ``heard`` None: one that does not say what it knows, and is taken to know all."""
        mine = self.own if heard is not None else {}
        known = (heard or {}).get(self.session, 0)
        unknown_there = [agent for agent, number in mine.items() if number > known]
        unknown_here = [agent for agent, number in (own or {}).items() if number > self.heard.get(session, 0)]
        if changes > self.changes:
            first, more, knows = pressed, unknown_there, dict(heard or {})
        elif changes == self.changes:
            first, more, knows = self.pressed, pressed, _latest(self.heard, heard or {})
        else:
            first, more, knows = self.pressed, unknown_here, self.heard
            if not unknown_here:
                return False
        became = [*first, *(agent for agent in more if agent not in first)][: self.PRESSED]
        self.changes = max(changes, self.changes) + (changes != self.changes and became != first[: self.PRESSED])
        self.heard = _latest(knows, {session: changes})
        for gone in list(self.heard)[: -self.HEARD]:
            del self.heard[gone]
        if became == self.pressed:
            return False
        self._become(became, by, now)
        return True

    def _become(self, pressed: list[str], by: str, now: float) -> None:
        self.presses += any(agent not in self.pressed for agent in pressed)
        was, self.pressed, self.stopped = self.stopped, pressed, bool(pressed)
        self.own = {agent: number for agent, number in self.own.items() if agent in pressed}
        self.counted = {agent: at for agent, at in self.counted.items() if agent in pressed}
        if was == self.stopped:
            return
        self.by, self.since = by, now
        self.times += self.stopped
        self.history.append(f"{'stopped' if self.stopped else 'released'} by {by}")
        del self.history[: -self.HISTORY]


def _latest(one: Mapping[str, int], other: Mapping[str, int]) -> dict[str, int]:
    return {**one, **{session: max(number, one.get(session, 0)) for session, number in other.items()}}
