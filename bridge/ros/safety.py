"""What makes a robot safe to teleoperate: who commands a topic, what happens when commands stop, the emergency stop.

Pure: the time is passed in, in seconds. Agents are whatever identifies them.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
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
        if holder is None:
            self._since = now
        self._holder, self._until = agent, now + self.hold_s
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
        self._commander: Hashable | None = None
        self._last = -math.inf

    @property
    def commander(self) -> Hashable | None:
        """Whose command was the last, while it is armed."""
        return self._commander

    def command(self, agent: Hashable, now: float) -> None:
        """A command was published."""
        self._commander, self._last = agent, now

    def deadline(self) -> float | None:
        """When it trips unless a command comes; None while it cannot."""
        if self._commander is None or self.silence_s is None:
            return None
        return self._last + self.silence_s

    def tick(self, now: float) -> bool:
        """Whether it trips now."""
        deadline = self.deadline()
        return deadline is not None and now >= deadline and self._trip(f"no command for {self.silence_s:g} s")

    def left(self, agent: Hashable) -> bool:
        """An agent is gone. Whether it trips."""
        return self._commander is not None and self._commander == agent and self._trip(f"{agent} left")

    def disarm(self, why: str) -> bool:
        """Somebody else stops the robot. Whether commands were under way."""
        return self._commander is not None and self._trip(why)

    def _trip(self, why: str) -> bool:
        self._commander = None
        self.trips += 1
        self.why = why
        return True


@dataclass
class EmergencyStop:
    """Latched: once stopped, stopped until released."""

    stopped: bool = False
    by: str = ""
    since: float = 0.0
    """Seconds since the epoch."""
    times: int = 0
    history: list[str] = field(default_factory=list)

    HISTORY = 20

    def press(self, by: str, now: float) -> bool:
        """Stop. Whether this is new."""
        if self.stopped:
            return False
        self.stopped, self.by, self.since = True, by, now
        self.times += 1
        self._note(f"stopped by {by}")
        return True

    def release(self, by: str, now: float) -> bool:
        """Go on. Whether this is new."""
        if not self.stopped:
            return False
        self.stopped, self.by, self.since = False, by, now
        self._note(f"released by {by}")
        return True

    def _note(self, what: str) -> None:
        self.history.append(what)
        del self.history[: -self.HISTORY]
