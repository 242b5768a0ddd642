"""What comes to a robot, judged before it can wait: commands are handled at once, and no flood costs another.

Pure: times are passed in. Each sender has credit, one for what is urgent and one for the rest; who is over it loses
the message before it is even looked at. So a flood costs the robot a fixed share of its time, and what is judged here
never waits behind it. A sender is what its keys end in, which routers hold certificates to.

Commands that have waited on their way are not carried out, unless they say to stand still (`halts`). How long they did
is worked out from the stamps that the first router puts on samples, without comparing clocks (`Ages`). Senders that
tell when they made their commands are held to that as well (`command_clock`).
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import NamedTuple, Protocol

from ..errors import WireError
from .agent_id import AgentId
from .came import CommandsCame
from .command_clock import CommandClocks
from .credit import Credit
from .halts import halts
from .keyexpr import CALLS, GROUP, UNICAST, sender_of, type_number
from .messages import ROS, Metadata, NodeType
from .reading import Message, Reader
from .robot_state import CommandCount
from .wire import Layout

STOP_TOPIC = "/emergency_stop"
"""Of a robot whose settings name no other."""
STOP_TYPES = frozenset({"std_msgs/Bool", "std_msgs/msg/Bool"})
"""Of emergency stops: what a robot's is called, only the robot knows."""
COMMAND = int(NodeType.PUBLISHER)
FLOODED = "it sends more than one agent may"
BEFORE_ROBOT = "before_robot"
"""The name of commands that were lost between a gateway and a robot."""
Buffer = bytes | bytearray

AGED_S = 0.01
"""What has waited less has not waited."""
SINGLE_BYTES = 2048
RUN_BYTES = 384
"""What is larger than a usual message costs as much as many small ones: a sample may hold several frames."""


BLOCKS = 16
"""Who calls for all agents of a block at once may bring as much as so many of them, before it is looked whose calls
they are: each of these has its own credit."""


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
        self._all = Credit(per_s * self.TOGETHER, -math.inf, most=per_s)  # at once no more than one may
        self._senders: OrderedDict[str, Credit] = OrderedDict()
        """Who sent longest ago comes first."""

    def take(self, sender: str, size: int, now: float) -> bool:
        """Whether a message of this size may pass."""
        credit = self._senders.get(sender)
        if credit is None:
            credit = self._senders[sender] = self._credit_of_another(now)
        else:
            self._senders.move_to_end(sender)
        cost = self._cost(size)
        return credit.take(cost, now) and (credit.left(now) >= self._little or self._all.take(cost, now))

    def covered(self, sender: str, size: int, messages: int, now: float) -> int:
        """How many of a sample's messages may pass, the first ones: before it was read, `take` took what a sample of
        its size costs as one message."""
        paid = int(self._cost(size))
        for number in range(paid, messages):
            if not self.take(sender, 0, now):
                return number
        return messages

    def _cost(self, size: int) -> float:
        return 1.0 if size <= SINGLE_BYTES else min(self._most, size / RUN_BYTES)

    def _credit_of_another(self, now: float) -> Credit:
        """What a new sender begins with; once there are too many, with what is left to whom it displaces: names that
        somebody makes up give him no more."""
        if len(self._senders) < self.SENDERS:
            return Credit(self._per_s, now)
        return self._senders.popitem(last=False)[1]


class Ages:
    """How long samples have waited on their way, by stamps of clocks that nobody has compared with ours.

    The difference between arrival and stamp is the way's length and that of the clocks; the smallest of the last
    minutes is a sample that did not wait. What another has more is the time that it waited.

    Whoever sends can write the stamp himself, and name any clock. So the smallest is each sender's own: what somebody
    forges makes nobody else's commands old or young, and the clocks that he makes up displace his own. Only who is new
    on a clock is compared with others as well, until it has been heard for `NEW_S`: what waited for it to connect is
    no younger because nobody knows it. It is held to the median of those that came last to that clock, the smaller one
    of two: a single forger among three shifts nothing, and where there are fewer he costs newcomers their commands for
    that long, or the comparison, as if there were nobody.
    """

    SENDERS = 1024
    CLOCKS = 4
    """Of one sender: it changes to another router when its own fails."""
    WITNESSES = 9
    """With so many senders of a clock a new one is compared."""
    NEW_S = 1.0
    HALF_S = 150.0
    """Twice as long at most a queue may stand in which everything waits, as somebody floods, before it is taken for
    the way's length. Clocks that are put forward make the difference smaller, and stamps never go back, so only their
    drift speaks against more: 30 ms at 100 ppm."""
    FORGET_S = 600.0
    """Two clocks drift apart: what was found so long ago says little, and only of what comes first (`NEW_S`)."""
    STANDS_S = 1e-6
    """A hybrid clock that was put forward stands still until time has come up to it, but for a tick per sample."""

    class _Way:
        """What one sender's samples with the stamps of one clock have said."""

        __slots__ = ("at", "before", "first", "least", "others", "since", "stamp", "stands")

        def __init__(self, stamp: float, now: float, others: float) -> None:
            self.stamp, self.at, self.since, self.first = stamp, now, now, now
            self.least = self.before = now - stamp
            self.stands = False
            self.others = others
            """The delay that others had when this one was new, and itself before; infinite when there was neither."""

        @property
        def delay(self) -> float:
            """Of a sample that did not wait."""
            return min(self.least, self.before)

    def __init__(self) -> None:
        self._ways: OrderedDict[str, OrderedDict[Hashable, Ages._Way]] = OrderedDict()
        """By sender and clock, those heard last at the end."""
        self._witnesses: dict[Hashable, OrderedDict[str, Ages._Way]] = {}
        """Some of them by clock, those that came last at the end."""

    def age(self, sender: str, clock: Hashable, stamp: float, now: float) -> float:
        """How long a sample with this stamp has waited, in s."""
        own = self._ways.get(sender)
        way = own.get(clock) if own is not None else None
        if own is None or way is None or now - way.at > self.FORGET_S:
            way = self._begin(sender, clock, stamp, now, way.delay if way is not None else math.inf)
            return max(0.0, now - stamp - min(way.least, way.others))
        self._ways.move_to_end(sender)
        own.move_to_end(clock)
        stands = abs(stamp - way.stamp) < self.STANDS_S and now - way.at > 100 * self.STANDS_S
        way.stamp, way.at = stamp, now
        delay = now - stamp
        stood, way.stands = way.stands, stands
        if stands and stood:  # the smallest is from when it was put forward; once, two may have been put in one moment
            way.least, way.before, way.since = delay, delay, now
        elif now - way.since > self.HALF_S:
            way.before, way.least, way.since = way.least, delay, now
        elif delay < way.least:
            way.least = delay
        if now - way.first <= self.NEW_S:
            return max(0.0, delay - min(way.delay, way.others))
        return max(0.0, delay - way.delay)

    def _begin(self, sender: str, clock: Hashable, stamp: float, now: float, before: float) -> Ages._Way:
        """Meet a sender on a clock on which it has not been heard, or not for long: then it had the delay ``before``,
        and what comes now may have waited ever since (a program that was suspended)."""
        way = self._Way(stamp, now, min(before, self._delay_of_others(sender, clock, now)))
        own = self._ways.setdefault(sender, OrderedDict())
        self._ways.move_to_end(sender)
        own[clock] = way
        own.move_to_end(clock)
        if len(own) > self.CLOCKS:
            self._dismiss(sender, own.popitem(last=False)[0])
        if len(self._ways) > self.SENDERS:
            gone, theirs = self._ways.popitem(last=False)
            for other in theirs:
                self._dismiss(gone, other)
        witnesses = self._witnesses.setdefault(clock, OrderedDict())
        witnesses[sender] = way
        witnesses.move_to_end(sender)
        if len(witnesses) > self.WITNESSES:
            witnesses.popitem(last=False)
        return way

    def _dismiss(self, sender: str, clock: Hashable) -> None:
        witnesses = self._witnesses.get(clock, OrderedDict())
        witnesses.pop(sender, None)
        if not witnesses:
            self._witnesses.pop(clock, None)

    def _delay_of_others(self, sender: str, clock: Hashable, now: float) -> float:
        ways = self._witnesses.get(clock, OrderedDict())
        delays = sorted(way.delay for other, way in ways.items() if other != sender and now - way.at <= self.FORGET_S)
        return delays[(len(delays) - 1) // 2] if delays else math.inf


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
        self._late: OrderedDict[str, tuple[float, float]] = OrderedDict()
        """Who has waited: when the last that was too old came, and the last at all. Who sent last is at the end."""

    def take(self, sender: str, age_s: float, now: float) -> bool:
        """Whether a command of this age is carried out."""
        if not self._max_age_s:
            return True
        if age_s > self._max_age_s:
            self._late[sender] = (now, now)
            self._late.move_to_end(sender)
            if len(self._late) > self.LATE:
                self._late.popitem(last=False)
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
        self._late.move_to_end(sender)
        return False


class Limits(NamedTuple):
    """What one sender may cost. 0: no limit."""

    commands_per_s: float = 0.0
    requests_per_s: float = 0.0
    max_command_age_s: float = 0.0
    max_timed_command_age_s: float = 0.0
    """The same of commands whose senders tell when they made them."""


OnCommand = Callable[[Message], None]
OnRefused = Callable[[Message, str, str], None]


class OnDropped(Protocol):
    """Hears of losses."""

    def __call__(self, name: str, about: str, text: str, count: int = 1, /) -> None:
        """The name of a loss, whose it was, why, and how much it was."""


class Admits(Protocol):
    """What calls have to pass; called in Zenoh's threads."""

    def admits(self, key: str, size: int, urgent: bool, now: float) -> bool:
        """Whether it may be looked at."""


class Gate(Admits, Protocol):
    """What samples have to pass; likewise."""

    def age(self, key: str, clock: Hashable, stamp: float, now: float) -> float:
        """How long a sample has waited on its way, by the stamp it bears."""

    def first(self, key: str, payload: Buffer, age_s: float, now: float) -> bool:
        """Take a sample now, whatever waits. False: the loop shall."""

    def rescue(self, key: str, payload: Buffer, now: float) -> None:
        """Look at one that is not admitted for what must pass nevertheless."""


class Guard:
    """The `Gate` of one robot agent.

    ``on_command`` judges one command and carries it out, in the thread that brought it; ``stop_name`` is the node name
    of the emergency stop, which nothing here holds back. Both are set later: until then nothing is taken here.
    """

    PRESSED = 1024

    def __init__(self, limits: Limits, layout: Layout) -> None:
        self.me = (ROS, 0)
        """Type and id of the robot, kept by the agent."""
        self.on_command: OnCommand | None = None
        self.on_dropped: OnDropped = lambda name, sender, why, count=1: None
        self.on_refused: OnRefused = lambda message, kind, why: None
        """Hears of single commands that were dropped, whose sender is to be told."""
        self._stop_name, self._stop_bytes = "", b""
        self._urgent = Allowances(limits.commands_per_s)
        self._requests = Allowances(limits.requests_per_s)
        self._rescued = Allowances(limits.commands_per_s)
        self._together = Allowances(BLOCKS * limits.requests_per_s)
        self._ages = Ages()
        self._fresh = Fresh(limits.max_command_age_s)
        self.clocks = CommandClocks(limits.max_timed_command_age_s)
        self.on_missing: OnDropped = lambda name, sender, why, count=1: None
        """Hears of commands that were put and have not come."""
        self._came = CommandsCame()
        self._pressed: OrderedDict[str, float] = OrderedDict()
        """When somebody asked for a stop last; who did so last is at the end."""
        self._reader = Reader(layout, self._found_bad)
        self._bad = False
        self._lock = threading.Lock()
        self._counting = threading.Lock()
        """Held for what is known of senders; never while a command is carried out."""

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
        with self._counting:
            requests = self._together if key.startswith(CALLS_KEYS) else self._requests
            admitted = (self._urgent if urgent else requests).take(sender, size, now)
        if urgent and key.startswith(INBOX_KEYS):
            self._came.has_come(key)
        if admitted:
            return True
        self.on_dropped("flooded", sender, FLOODED)
        return False

    def age(self, key: str, clock: Hashable, stamp: float, now: float) -> float:
        """How long a sample has waited on its way."""
        with self._counting:
            return self._ages.age(sender_of(key), clock, stamp, now)

    def first(self, key: str, payload: Buffer, age_s: float, now: float) -> bool:
        """Carry out the commands of a sample. False: it holds something else, of which only a stop was carried out;
        the loop has all of it in order, and asks `judge` about its commands."""
        command = self.on_command
        if command is None:
            return False
        with self._lock:  # of two threads each has its turn: what one sender put stays in order
            messages = self._read(key, payload)
            if len(messages) == 1 and messages[0].metadata.message_manager == CommandCount.manager:
                self._count(key, messages[0])
                return True
            if self._bad or not messages or not all(_is_command(message) for message in messages):
                for message in messages:
                    if self._stops(message):
                        command(message)
                return False
            sender = sender_of(key)
            for message in self._covered(self._urgent, sender, len(payload), messages, now):
                most_s = self._passes(message, sender, age_s, now)
                if most_s is not None:
                    command(message if max(age_s, most_s) <= AGED_S else _aged(message, age_s, most_s))
        return True

    def _count(self, key: str, message: Message) -> None:
        """A gateway has told how many commands of one sender it has put."""
        try:
            missing = self._came.told(key, message.data)
        except WireError as error:
            self.on_dropped("bad_request", sender_of(key), str(error))
            return
        if missing:
            self.on_missing(BEFORE_ROBOT, sender_of(key), "some of its commands do not come here", missing)

    def covered(self, key: str, size: int, messages: list[Message], now: float) -> list[Message]:
        """Of a sample that comes to the loop: as many of its messages as its sender may send, and stops."""
        if len(messages) == 1 and messages[0].metadata.message_manager == CommandCount.manager:
            return []  # not the way of commands, so it says nothing of them, whoever sent it
        return self._covered(self._requests, sender_of(key), size, messages, now)

    def _covered(
        self, allowances: Allowances, sender: str, size: int, messages: list[Message], now: float
    ) -> list[Message]:
        """A sample may hold hundreds of messages, each of which has its cost."""
        if len(messages) <= 1:
            return messages
        with self._counting:
            most = allowances.covered(sender, size, len(messages), now)
        kept = messages[:most] + [message for message in messages[most:] if self._stops(message)]
        if len(kept) < len(messages):
            self.on_dropped("flooded", sender, FLOODED, len(messages) - len(kept))
        return kept

    def judge(self, message: Message, key: str, age_s: float, now: float) -> Message | None:
        """A message that comes to the loop, with its age, if it is delivered: commands among others, or in a sample
        too large to be looked at before, are held to the same."""
        if not _is_command(message):
            return message._replace(age_s=age_s)
        with self._lock:
            most_s = self._passes(message, sender_of(key), age_s, now)
        return None if most_s is None else _aged(message, age_s, most_s)

    def pressed(self, sender: tuple[int, int], now: float) -> None:
        """Somebody stops the robot by asking, which overtakes what it puts: a release that it sent before is not what
        it wants now. It waits for no command that is being carried out, so one that releases may be: whoever releases
        asks `overtaken` once more in the moment in which he does."""
        with self._counting:
            self._pressed[name := str(AgentId(*sender))] = now
            self._pressed.move_to_end(name)
            if len(self._pressed) > self.PRESSED:
                self._pressed.popitem(last=False)

    def overtaken(self, message: Message, now: float) -> bool:
        """Whether a release was sent before the stop for which its sender asked."""
        sender = str(AgentId(type_number(message.sender_type), message.sender_id))
        return self._overtaken(message, sender, message.age_s, now)

    def rescue(self, key: str, payload: Buffer, now: float) -> None:
        """Of a sample that is not admitted: whoever floods may still stop the robot. What names the stop and does not
        stop is a flood as well, so that this has an allowance of its own."""
        command = self.on_command
        if command is None or not self.stop_name or self._stop_bytes not in payload:
            return
        with self._counting:
            if not self._rescued.take(sender_of(key), len(payload), now):
                return
        with self._lock:
            for message in self._read(key, payload):
                if self._stops(message):
                    command(message)

    def _passes(self, message: Message, sender: str, age_s: float, now: float) -> float | None:
        """How old a command that is carried out is at most by its sender's clock; None: it is not."""
        if self._stops(message):
            return 0.0
        if self._overtaken(message, sender, age_s, now):
            self.on_dropped("too_old", sender, "a release was sent before the stop that its sender asked for")
            return None
        halt = says_halt(message)
        told = self.clocks.judge(sender, message.metadata, now, halts=halt)
        if told.refusal is not None:
            self.on_dropped(told.refusal.kind, sender, told.refusal.reason)
            self.on_refused(message, *told.refusal)
            return None
        if self._fresh.take(sender, age_s, now) or halt:
            return told.age_s
        self.on_dropped("too_old", sender, f"a command has waited for {age_s:.2f} s on its way, or behind such a one")
        return None

    def _overtaken(self, message: Message, sender: str, age_s: float, now: float) -> bool:
        if not self._pressed or not self.stop_name or message.metadata.node_name != self.stop_name:
            return False
        return self._pressed.get(sender, -math.inf) > now - age_s

    def _stops(self, message: Message) -> bool:
        name = message.metadata.node_name
        return bool(name) and name == self.stop_name and _is_command(message) and presses(message.data)

    def _read(self, key: str, payload: Buffer) -> list[Message]:
        self._bad = False
        if key.startswith(INBOX_KEYS) and (again := self._reader.reread(key, payload)) is not None:
            return [again]
        return self._reader.read(key, payload, self.me, by_group=key.startswith(GROUP_KEYS))

    def _found_bad(self, _key: str, _error: WireError) -> None:
        self._bad = True  # the loop finds it too, and counts it


def _aged(message: Message, age_s: float, at_most_s: float) -> Message:
    return message._replace(age_s=age_s, at_most_s=at_most_s)


INBOX_KEYS, GROUP_KEYS, CALLS_KEYS = UNICAST.prefix, GROUP.prefix, CALLS.prefix


def presses(data: bytes) -> bool:
    """Whether data for the emergency stop stops: not more than is needed to know, the stop itself looks closer."""
    return len(data) > 4 and data[4] != 0


def is_press(metadata: Metadata, data: Buffer | memoryview) -> bool:
    """Whether a message to a robot may be a press of its emergency stop."""
    command = metadata.node_type == COMMAND and metadata.data_exchange_type in STOP_TYPES
    return command and presses(bytes(data[:5]))


def says_halt(message: Message) -> bool:
    """Whether a command says to stand still: it does however old it is, for nobody may say it again."""
    return halts(message.metadata.data_exchange_type, message.data)


def _is_command(message: Message) -> bool:
    return message.metadata.node_type == COMMAND and bool(message.metadata.node_name)
