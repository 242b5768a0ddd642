"""Topics of robots as they come: their messages, how often, how much and how old."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import struct
import time
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from macs_zenoh.errors import UsageError, WireError
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.offers import absolute
from macs_zenoh.timeouts import within
from macs_zenoh.topics import TopicMessage, TopicSubscription
from macs_zenoh.typed import Types

from .rates import Ages, Arrivals, Sizes
from .site import Site, named, type_of
from .words import FieldPath, as_csv, as_yaml, field_of

log = logging.getLogger("macs.graph")

DEPTH = 1000
"""Messages that may wait here and at the robot: what is counted must not be lost for want of a moment."""
REPORT_S = 1.0
"""How often rates are told, as ros2cli does."""
SILENCE_S = 3.0
"""After so long without a message it is said that none comes."""
SUMMARY_BYTES = 256
"""Longer arrays are shown as their size, unless whole ones are wanted."""

_TIME = struct.Struct("<iI")

Say = Callable[[str], None]
"""Takes one line, or several, for stdout."""
Emit = Callable[[Mapping[str, Any]], None]
"""Takes one object, for a line of JSON."""


@dataclass(frozen=True)
class Shown:
    """How messages are shown."""

    form: str = "yaml"
    """``yaml``, ``flow`` (YAML in one line), ``csv`` or ``json``."""
    field: FieldPath = ()
    """Only this part of each."""
    whole: bool = False
    """Arrays whole, however long."""


@dataclass(frozen=True)
class End:
    """When it has been enough: after so many messages or seconds, if at all."""

    count: int | None = None
    timeout_s: float | None = None

    def code(self, taken: int) -> int:
        """The exit code after so many: 1 for fewer than were wanted, or none at all."""
        return 0 if taken and (self.count is None or taken >= self.count) else 1


@contextlib.asynccontextmanager
async def subscribed(site: Site, topic: str, of_type: str | None) -> AsyncIterator[TopicSubscription]:
    """A topic of the robots that are meant: those that were named, or all that are online and publish it.

    Raises Unreachable, UsageError, Refused, CallTimeout.
    """
    topic = absolute(topic)
    robots = site.must_be_online()
    if of_type is None or not site.chosen:
        offers = await (site.offers if of_type else site.must_offer)(robots)
        of_type = of_type or type_of(topic, NodeType.SUBSCRIBER, offers)
        publishing = [robot for robot, offered in offers.items() if topic in offered.publishers]
        robots = publishing or robots
    chosen = site.chosen
    subscription = await site.agent.subscribe(
        topic,
        robot=chosen.robots if chosen else robots,
        group=chosen.groups,
        type=of_type,
        depth=DEPTH,
        timeout_s=site.timeout_s,
    )
    with subscription:
        yield subscription


async def echo(site: Site, topic: str, of_type: str | None, shown: Shown, end: End, say: Say, emit: Emit) -> int:
    """Show messages until it has been enough. Returns the exit code. Raises what `subscribed` raises."""
    types = Types()
    taken = 0
    async with subscribed(site, topic, of_type) as subscription:
        several = len(site.online()) > 1 and not (len(site.chosen.robots) == 1 and not site.chosen.groups)

        async def take() -> None:
            nonlocal taken
            async for message in _unless_silent(subscription, site):
                _show(message, types, shown, several, say, emit)
                taken += 1
                if taken == end.count:
                    return

        with contextlib.suppress(asyncio.TimeoutError):
            await within(take(), end.timeout_s)
        if subscription.dropped:
            log.warning("%d messages were not shown: they came faster than they can be shown", subscription.dropped)
    return end.code(taken) if end.count or end.timeout_s else 0


def _show(message: TopicMessage, types: Types, shown: Shown, several: bool, say: Say, emit: Emit) -> None:
    try:
        whole = shown.whole or shown.form == "csv"
        value: Any = types.deserialize(message.type, message.data, max_bytes=None if whole else SUMMARY_BYTES)
    except WireError as error:
        log.warning("a message of robot %d cannot be read: %s", message.robot, error)
        return
    if shown.field:
        value = field_of(value, shown.field)
    if shown.form == "json":
        emit({"topic": message.topic, "robot": message.robot, "message": value})
    elif shown.form == "csv":
        say(f"{message.robot},{as_csv(value)}" if several else as_csv(value))
    else:
        say((f"# robot {message.robot}\n" if several else "") + as_yaml(value, flow=shown.form == "flow") + "\n---")


async def _unless_silent(subscription: TopicSubscription, site: Site) -> AsyncIterator[TopicMessage]:
    """Its messages; where none comes for a while, that is said once."""
    loop = asyncio.get_running_loop()

    def tell() -> None:
        where = named(site.online()) if site.online() else "any robot"
        log.warning("nothing has come from %s on %s yet", where, subscription.topic)

    telling = loop.call_later(SILENCE_S, tell)
    try:
        async for message in subscription:
            telling.cancel()
            yield message
    finally:
        telling.cancel()


class Measured:
    """A window for each robot, filled by messages."""

    def __init__(self, what: str, make: Callable[[], Arrivals | Sizes | Ages]) -> None:
        self.what = what
        self._make = make
        self.of: dict[int, Arrivals | Sizes | Ages] = {}

    def window(self, robot: int) -> Any:
        """That of one robot."""
        if robot not in self.of:
            self.of[robot] = self._make()
        return self.of[robot]


def measure_rate(measured: Measured, message: TopicMessage) -> None:
    """By when it came."""
    measured.window(message.robot).came(message.received_s)


def measure_size(measured: Measured, message: TopicMessage) -> None:
    """By its CDR."""
    measured.window(message.robot).came(message.received_s, len(message.data))


class Delay:
    """Takes the age of messages, by the clocks of this host and the robots', as far as they could be compared."""

    def __init__(self, ahead_s: Mapping[int, float], *, offset_s: float) -> None:
        self._ahead_s = ahead_s
        self._offset_s = offset_s
        """What the clock of the day is ahead of the monotonic one."""

    def __call__(self, measured: Measured, message: TopicMessage) -> None:
        """By its header, which its type has at its beginning. The clock that stamped it is taken for the robot's."""
        if len(message.data) < 12:
            return
        order = _TIME if message.data[1] & 1 else struct.Struct(">iI")
        seconds, nanoseconds = order.unpack_from(message.data, 4)
        received_s = message.received_s + self._offset_s + self._ahead_s.get(message.robot, 0.0)
        measured.window(message.robot).came(received_s - (seconds + nanoseconds / 1e9))


def must_have_header(types: Types, of_type: str) -> None:
    """Raise UsageError for a type that does not begin with a header."""
    value = types.deserialize(of_type, types.serialize(of_type, {}))
    first = next(iter(value.items()), ("", None))
    if first[0] != "header" or not isinstance(first[1], dict) or set(first[1]) != {"stamp", "frame_id"}:
        raise UsageError(f"messages of type {of_type} have no header, so nobody knows when they were made")


async def watch(
    site: Site,
    topic: str,
    of_type: str | None,
    measured: Measured,
    take_in: Callable[[Measured, TopicMessage], None],
    end: End,
    say: Say,
    emit: Emit,
    *,
    form: str = "text",
) -> int:
    """Tell every second what was measured, until it has been enough; of an end that comes before, once more.

    Returns the exit code. Raises what `subscribed` raises.
    """
    taken = told = 0

    def tell(subscription: TopicSubscription) -> None:
        nonlocal told
        if taken != told:
            told = taken
            for robot, window in sorted(measured.of.items()):
                _tell(subscription.topic, robot, window, len(measured.of) > 1, form, say, emit)

    types = Types()
    if isinstance(take_in, Delay):  # before anything comes: to load them takes longer than messages do
        types.serialize("std_msgs/msg/Header", {})
    async with subscribed(site, topic, of_type) as subscription:

        async def take() -> None:
            nonlocal taken
            async for message in _unless_silent(subscription, site):
                take_in(measured, message)
                taken += 1
                if taken == end.count:
                    return

        async def report() -> None:
            while True:
                await asyncio.sleep(REPORT_S)
                tell(subscription)

        if isinstance(take_in, Delay):
            must_have_header(types, subscription.type)
        reporting = asyncio.get_running_loop().create_task(report())
        try:
            with contextlib.suppress(asyncio.TimeoutError):
                await within(take(), end.timeout_s)
        finally:
            reporting.cancel()
            tell(subscription)
        if subscription.dropped:
            log.warning("%d messages were not counted: they came faster than they are taken", subscription.dropped)
    return end.code(taken) if end.count or end.timeout_s else 0


def _tell(
    topic: str, robot: int, window: Arrivals | Sizes | Ages, several: bool, form: str, say: Say, emit: Emit
) -> None:
    facts = window.facts()
    if facts is None:
        return
    if form == "json":
        emit({"topic": topic, "robot": robot, **dict(zip(window.NAMES, map(_rounded, facts), strict=True))})
    elif form == "csv":
        say(as_csv([robot, *map(_rounded, facts)]))
    else:
        say((f"robot {robot}\n" if several else "") + (window.lines() or ""))


def _rounded(number: float) -> float | int | None:
    if isinstance(number, int):
        return number
    return round(number, 6) if abs(number) != float("inf") else None


async def compared_clocks(site: Site, robots: Collection[int]) -> dict[int, float]:
    """How far the clocks of robots are ahead of ours, in seconds; said in the log with its bound."""
    ahead: dict[int, float] = {}
    for robot in robots:
        clock = await site.clock(robot)
        if clock is None:
            log.warning("the clock of robot %d could not be compared with ours: taken for the same", robot)
            continue
        log.info(
            "the clock of robot %d is %.3f ms ahead of ours, within %.3f ms: allowed for",
            robot,
            clock.ahead_s * 1000,
            clock.within_s * 1000,
        )
        ahead[robot] = clock.ahead_s
    return ahead


def offset_of_clocks() -> float:
    """What the clock of the day is ahead of the monotonic one, in seconds."""
    return time.time() - time.monotonic()
