"""The way of one message, hop by hop: what programs note of messages that are traced, and what follows from it. Pure.

A *report* is what one receiver knows of one message: when it passed each point of its way, as the clock there had it.
Points follow each other, so the times between them add up to the whole.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, NamedTuple

import msgspec

from ..errors import BadField, BadJson, TooLong
from .keyexpr import STREAM, UNICAST
from .messages import ROS, Count

PREFIX = b"macs: trace "
"""How a ping begins that asks for traces; JSON follows it (`TraceRequest`)."""
ASKED_BYTES = 4096
ANSWER_BYTES = 1 << 20
MARK_BYTES = 512
MOST_POINTS = 24
MOST_REPORTS = 1000
"""Reports that a program keeps until somebody asks for them."""
MOST_EVERY = 1_000_000
LONGEST_S = 60.0
"""So long a request holds; who wants more asks again."""

_MARK = struct.Struct("<4sQB")
_NOTE = struct.Struct("<Bq")
_MAGIC = b"mtr1"

ROS_SENT, TAKEN, SOCKET, PUT = "ROS node", "taken", "socket", "put"
SENT, ROUTER, RECEIVED = "sent", "router", "received"
IN, DONE = "in", "done"
NOTES = (ROS_SENT, TAKEN, SOCKET, PUT)
"""Points that the sender notes itself, before Zenoh has the message; in this order."""


class TraceRequest(msgspec.Struct, frozen=True):
    """What is asked of a program: to mark one in ``every`` of what it puts with keys that begin with ``put``, to note
    what comes marked, and to tell what it has noted since report ``after``. It holds for ``seconds``."""

    put: str = ""
    every: int = 1
    commands: bool = False
    """Only what has the priority of commands."""
    look: bool = True
    seconds: float = 5.0
    after: int = 0


Ns = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
"""Since 1970, by some clock."""


class Point(NamedTuple):
    """A message was here: the point's name, nanoseconds since 1970, and whose clock that is."""

    name: str
    at_ns: int
    clock: str


class Report(msgspec.Struct, frozen=True, array_like=True):
    """One message as one receiver saw it. ``number`` counts the receiver's reports; ``way`` is how the message was
    handled there, ``at once`` or ``loop``."""

    number: Count
    mark: int
    key: str
    way: str
    points: list[tuple[str, Ns, str]]


class TraceAnswer(msgspec.Struct, frozen=True):
    """What a program has noted. ``missed``: reports that nobody asked for in time."""

    reports: list[Report] = []
    missed: Count = 0


def said_by(robot: int) -> str:
    """How the keys begin of what a robot sends to all who registered."""
    return STREAM.every(type=ROS, id=robot).removesuffix("**")


def told_to(robot: int) -> str:
    """How the keys begin of what is sent to a robot by its id, commands among others."""
    return UNICAST.every(type=ROS, id=robot).removesuffix("**")


def encode_request(request: TraceRequest) -> bytes:
    """What is sent with a ping."""
    return PREFIX + msgspec.json.encode(request)


def decode_request(asked: bytes) -> TraceRequest:
    """Raises TooLong, BadJson, BadField."""
    if len(asked) > ASKED_BYTES:
        raise TooLong("a request for traces", len(asked), ASKED_BYTES)
    try:
        request = msgspec.json.decode(asked[len(PREFIX) :], type=TraceRequest)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("a request for traces", str(error)) from None
    if not 1 <= request.every <= MOST_EVERY:
        raise BadField("every", f"it is {request.every}")
    if not 0 < request.seconds <= LONGEST_S:
        raise BadField("seconds", f"it is {request.seconds}, and at most {LONGEST_S:g} are allowed")
    return request


def encode_answer(answer: TraceAnswer) -> bytes:
    """As many reports as an answer may have, the oldest first."""
    reports = answer.reports
    while len(encoded := msgspec.json.encode(TraceAnswer(reports, answer.missed))) > ANSWER_BYTES:
        reports = reports[: len(reports) // 2]
    return encoded


def decode_answer(told: bytes) -> TraceAnswer:
    """Raises TooLong, BadJson. A program that knows no traces has sent the question back: nothing."""
    if told.startswith(PREFIX):
        return TraceAnswer()
    if len(told) > ANSWER_BYTES:
        raise TooLong("traces", len(told), ANSWER_BYTES)
    try:
        return msgspec.json.decode(told, type=TraceAnswer)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise BadJson("traces", str(error)) from None


def encode_mark(mark: int, notes: Iterable[tuple[str, int]]) -> bytes:
    """What travels with a message that is traced: its number, and when it passed which of `NOTES`."""
    noted = list(notes)
    head = _MARK.pack(_MAGIC, mark, len(noted))
    return head + b"".join(_NOTE.pack(NOTES.index(name), at_ns) for name, at_ns in noted)


def decode_mark(data: bytes) -> tuple[int, list[tuple[str, int]]] | None:
    """The same read; None for what is no such mark, which others may attach for purposes of their own."""
    if not _MARK.size <= len(data) <= MARK_BYTES:
        return None
    magic, mark, count = _MARK.unpack_from(data)
    if magic != _MAGIC or len(data) != _MARK.size + count * _NOTE.size:
        return None
    notes = []
    for at in range(count):
        number, at_ns = _NOTE.unpack_from(data, _MARK.size + at * _NOTE.size)
        if number >= len(NOTES):
            return None
        notes.append((NOTES[number], at_ns))
    return mark, notes


# -- what follows from reports ---------------------------------------------------------------------------------------


class Offset(NamedTuple):
    """How far a clock is ahead of ours, in ns, and within what that is known; None: it is not."""

    ahead_ns: float = 0.0
    within_ns: float | None = None


class Hop(NamedTuple):
    """The time between two points."""

    name: str
    took_ns: float


def hop_name(before: Point, after: Point, names: Mapping[str, str]) -> str:
    """What lies between two points; ``names`` are those of clocks, as ``router 3c41ba1c``."""

    def who(point: Point) -> str:
        return names.get(point.clock) or f"{'router ' if point.name == ROUTER else ''}{point.clock[:8]}"

    if before.clock != after.clock:
        return f"{who(before)} to {who(after)}"
    inside = {
        (ROS_SENT, TAKEN): "ROS to its agent",
        (TAKEN, PUT): "agent",
        (SOCKET, PUT): "gateway",
        (PUT, SENT): "into Zenoh",
        (RECEIVED, IN): "out of Zenoh",
        (IN, DONE): "handled",
    }
    return f"{who(before)}: {inside.get((before.name, after.name), f'{before.name} to {after.name}')}"


def corrected(points: Sequence[Point], clocks: Mapping[str, Offset]) -> list[Point]:
    """The same by our clock, as far as clocks are known."""
    nothing = Offset()
    return [point._replace(at_ns=point.at_ns - round(clocks.get(point.clock, nothing).ahead_ns)) for point in points]


def hops(points: Sequence[Point], names: Mapping[str, str]) -> Iterator[Hop]:
    """The times between points, which add up to the time between the first and the last."""
    for before, after in itertools.pairwise(points):
        yield Hop(hop_name(before, after, names), after.at_ns - before.at_ns)


def bound_by_order(ways: Iterable[Sequence[Point]], clock: str) -> Offset:
    """What the order of points says of a clock that nobody could compare: a message is not here before it was sent
    there, and not there before it was here. ``ways`` are by our clock but for this one.

    No difference is assumed where that is possible; else the middle of what is.
    """
    low, high = -math.inf, math.inf
    for way in ways:
        for at, point in enumerate(way):
            if point.clock != clock:
                continue
            before = next((other for other in reversed(way[:at]) if other.clock != clock), None)
            after = next((other for other in way[at + 1 :] if other.clock != clock), None)
            if after is not None:
                low = max(low, point.at_ns - after.at_ns)
            if before is not None:
                high = min(high, point.at_ns - before.at_ns)
    if math.isinf(low) or math.isinf(high):
        return Offset()
    if low <= 0 <= high:
        return Offset(0.0, max(-low, high))
    return Offset((low + high) / 2, abs(high - low) / 2)


def at_share(ordered: Sequence[float], share: float) -> float:
    """The value that this share of them does not exceed."""
    return ordered[min(len(ordered) - 1, max(0, math.ceil(share * len(ordered)) - 1))]
