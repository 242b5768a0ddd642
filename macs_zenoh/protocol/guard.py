"""What comes to a robot, judged before it can wait: commands are handled at once, and no flood costs another.

Pure: times are passed in. Each sender has credit, one for what is urgent and one for the rest; who is over it loses
the message before it is even looked at. So a flood costs the robot a fixed share of its time, and what is judged here
never waits behind it. A sender is what its keys end in, which routers hold certificates to.

Commands that have waited on their way are not carried out. How long they did is worked out from the stamps that the
first router puts on samples, without comparing clocks (`Ages`).
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import NamedTuple, Protocol

from ..errors import WireError
from .credit import Credit
from .messages import ROS, NodeType
from .reading import Message, Reader
from .wire import Layout

COMMAND = int(NodeType.PUBLISHER)
Buffer = bytes | bytearray

SINGLE_BYTES = 2048
RUN_BYTES = 384
"""What is larger than a usual message costs as much as many small ones: a sample may hold several frames."""


class Allowances:
    """How many messages each sender may send, and all together."""

    SENDERS = 4096
    TOGETHER = 4
    """So many senders at their limit are served. More would take the time that commands need."""
    LITTLE = 0.75
    """Who has as much of its credit left has sent little, and passes whatever others do."""

    def __init__(self, per_s: float) -> None:
        self._per_s = per_s
        self._most = max(1.0, per_s / 4)
        self._little = self.LITTLE * per_s
        self._all = Credit(per_s * self.TOGETHER, -math.inf)
        self._senders: dict[str, Credit] = {}

    def take(self, sender: str, size: int, now: float) -> bool:
        """Whether a message of this size may pass."""
        credit = self._senders.get(sender)
        if credit is None:
            if len(self._senders) >= self.SENDERS:
                self._senders.clear()
            credit = self._senders[sender] = Credit(self._per_s, now)
        cost = 1.0 if size <= SINGLE_BYTES else min(self._most, size / RUN_BYTES)
        return credit.take(cost, now) and (credit.left(now) >= self._little or self._all.take(cost, now))


class Ages:
    """How long samples have waited on their way, by stamps of clocks that nobody has compared with ours.

    The difference between arrival and stamp is the way's length and that of the clocks; the smallest of the last
    minute is a sample that did not wait. What another has more is the time that it waited.
    """

    CLOCKS = 64
    HALF_S = 30.0
    FORGET_S = 600.0
    """Two clocks drift apart: what was found so long ago says nothing."""
    STANDS_S = 1e-5
    """A hybrid clock that was put forward stands still until time has come up to it, but for a tick per sample."""

    class _Clock:
        """One clock that stamps."""

        __slots__ = ("at", "before", "least", "since", "stamp")

        def __init__(self, stamp: float, now: float) -> None:
            self.stamp, self.at, self.since = stamp, now, now
            self.least = self.before = now - stamp

    def __init__(self) -> None:
        self._clocks: OrderedDict[Hashable, Ages._Clock] = OrderedDict()

    def age(self, clock: Hashable, stamp: float, now: float) -> float:
        """How long a sample with this stamp has waited, in s."""
        seen = self._clocks.get(clock)
        if seen is None or now - seen.at > self.FORGET_S:
            if len(self._clocks) >= self.CLOCKS:
                self._clocks.popitem(last=False)
            self._clocks[clock] = self._Clock(stamp, now)
            return 0.0
        self._clocks.move_to_end(clock)
        stands = abs(stamp - seen.stamp) < self.STANDS_S and now - seen.at > 100 * self.STANDS_S
        seen.stamp, seen.at = stamp, now
        delay = now - stamp
        if stands:  # the smallest is from when it was put forward
            seen.least, seen.before, seen.since = delay, delay, now
            return 0.0
        if now - seen.since > self.HALF_S:
            seen.before, seen.least, seen.since = seen.least, delay, now
        elif delay < seen.least:
            seen.least = delay
        return max(0.0, delay - min(seen.least, seen.before))


class Fresh:
    """Of commands that have waited too long, and of those behind them, none is carried out until one comes in time."""

    FRESH_S = 0.1
    GAP_S = 0.005
    """What has waited together comes together; so long after the one before, a command did not wait with it."""
    NO_WAIT_S = 0.01
    LATE_S = 1.0
    """After so long without one that is too old, what comes has not waited: the way has become longer."""
    LATE = 1024

    def __init__(self, max_age_s: float) -> None:
        self._max_age_s = max_age_s
        self._late: dict[str, tuple[float, float]] = {}
        """Who has waited: when the last that was too old came, and the last at all."""

    def take(self, sender: str, age_s: float, now: float) -> bool:
        """Whether a command of this age is carried out."""
        if not self._max_age_s:
            return True
        if age_s > self._max_age_s:
            if len(self._late) >= self.LATE:
                self._late.clear()
            self._late[sender] = (now, now)
            return False
        late = self._late.get(sender)
        if late is None:
            return True
        since, last = late
        in_time = age_s <= self.NO_WAIT_S or (age_s <= self.FRESH_S and now - last >= self.GAP_S)
        if in_time or now - since > self.LATE_S:
            del self._late[sender]
            return True
        self._late[sender] = (since, now)
        return False


class Limits(NamedTuple):
    """What one sender may cost. 0: no limit."""

    commands_per_s: float = 0.0
    requests_per_s: float = 0.0
    max_command_age_s: float = 0.0


OnCommand = Callable[[Message], None]
OnDropped = Callable[[str, str, str], None]
"""The name of a loss, whose it was, and why."""


class Gate(Protocol):
    """What samples have to pass; called in Zenoh's threads."""

    def admits(self, key: str, size: int, urgent: bool, now: float) -> bool:
        """Whether a sample may be looked at."""

    def first(self, key: str, payload: Buffer, age_s: float, now: float) -> bool:
        """Take a sample now, whatever waits. False: it has done nothing, and the loop shall."""

    def rescue(self, key: str, payload: Buffer, now: float) -> None:
        """Look at one that is not admitted for what must pass nevertheless."""


class Guard:
    """The `Gate` of one robot agent.

    ``on_command`` judges one command and carries it out, in the thread that brought it; ``stop_name`` is the node name
    of the emergency stop, which nothing here holds back. Both are set later: until then nothing is taken here.
    """

    def __init__(self, limits: Limits, layout: Layout) -> None:
        self.me = (ROS, 0)
        """Type and id of the robot, kept by the agent."""
        self.on_command: OnCommand | None = None
        self.on_dropped: OnDropped = lambda name, sender, why: None
        self._stop_name, self._stop_bytes = "", b""
        self._urgent = Allowances(limits.commands_per_s)
        self._requests = Allowances(limits.requests_per_s)
        self._rescued = Allowances(limits.commands_per_s)
        self._fresh = Fresh(limits.max_command_age_s)
        self._reader = Reader(layout, self._found_bad)
        self._bad = False
        self._lock = threading.Lock()

    @property
    def stop_name(self) -> str:
        """Node name of the emergency stop; empty: there is none."""
        return self._stop_name

    @stop_name.setter
    def stop_name(self, name: str) -> None:
        self._stop_name, self._stop_bytes = name, name.encode()

    def admits(self, key: str, size: int, urgent: bool, now: float) -> bool:
        """Whether a sample may be looked at."""
        sender = sender_of(key)
        if (self._urgent if urgent else self._requests).take(sender, size, now):
            return True
        self.on_dropped("flooded", sender, "it sends more than one agent may")
        return False

    def first(self, key: str, payload: Buffer, age_s: float, now: float) -> bool:
        """Carry out the commands of a sample. False: it is none, and nothing was done."""
        command = self.on_command
        if command is None:
            return False
        with self._lock:  # of two threads each has its turn: what one sender put stays in order
            messages = self._read(key, payload)
            if self._bad or not messages or not all(_is_command(message) for message in messages):
                return False
            sender = sender_of(key)
            for message in messages:
                if self._passes(message, sender, age_s, now):
                    command(message)
        return True

    def rescue(self, key: str, payload: Buffer, now: float) -> None:
        """Of a sample that is not admitted: whoever floods may still stop the robot. What names the stop and does not
        stop is a flood as well, so that this has an allowance of its own."""
        command, name = self.on_command, self.stop_name
        if command is None or not name or self._stop_bytes not in payload:
            return
        if not self._rescued.take(sender_of(key), len(payload), now):
            return
        with self._lock:
            for message in self._read(key, payload):
                if _is_command(message) and message.metadata.node_name == name and presses(message.data):
                    command(message)

    def _passes(self, message: Message, sender: str, age_s: float, now: float) -> bool:
        if self.stop_name and message.metadata.node_name == self.stop_name and presses(message.data):
            return True
        if self._fresh.take(sender, age_s, now):
            return True
        self.on_dropped("too_old", sender, f"a command has waited for {age_s:.2f} s on its way, or behind such a one")
        return False

    def _read(self, key: str, payload: Buffer) -> list[Message]:
        self._bad = False
        if key.startswith(INBOX_KEYS) and (again := self._reader.reread(key, payload)) is not None:
            return [again]
        return self._reader.read(key, payload, self.me, by_group=key.startswith(GROUP_KEYS))

    def _found_bad(self, _key: str, _error: WireError) -> None:
        self._bad = True  # the loop finds it too, and counts it


INBOX_KEYS = "macs/to/"
GROUP_KEYS = "macs/group/"


def presses(data: bytes) -> bool:
    """Whether data for the emergency stop stops: not more than is needed to know, the stop itself looks closer."""
    return len(data) > 4 and data[4] != 0


def sender_of(key: str) -> str:
    """Type and id at the end of a key."""
    at = key.rfind("/", 0, max(0, key.rfind("/")))
    return key[at + 1 :]


def _is_command(message: Message) -> bool:
    return message.metadata.node_type == COMMAND and bool(message.metadata.node_name)
