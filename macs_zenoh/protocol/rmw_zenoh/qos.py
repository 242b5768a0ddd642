"""Quality of service of a ROS endpoint, and how rmw_zenoh writes it in a token.

``reliability:durability:history,depth:deadline s,ns:lifespan s,ns:liveliness,lease s,ns``; what equals rmw_zenoh's
default is left empty. The numbers are those of rmw's enums.
"""

from __future__ import annotations

import re
from enum import IntEnum

from msgspec import Struct

ENDLESS_NS = (1 << 63) - 1
"""No deadline, no lifespan, no lease: 9223372036 s and 854775807 ns."""
DEFAULT_DEPTH = 42
"""What rmw_zenoh takes where nobody says."""

_SECOND = 1_000_000_000


class Reliability(IntEnum):
    """Whether lost messages are sent again."""

    RELIABLE = 1
    BEST_EFFORT = 2
    BEST_AVAILABLE = 4


class Durability(IntEnum):
    """Whether a publisher holds messages for subscriptions that come later."""

    TRANSIENT_LOCAL = 1
    VOLATILE = 2
    BEST_AVAILABLE = 4


class History(IntEnum):
    """Which messages wait to be taken."""

    KEEP_LAST = 1
    KEEP_ALL = 2


class Liveliness(IntEnum):
    """What keeps an endpoint alive."""

    AUTOMATIC = 1
    MANUAL_BY_TOPIC = 3
    BEST_AVAILABLE = 5


class Qos(Struct, frozen=True, kw_only=True):
    """A profile. Durations in ns; `ENDLESS_NS` is none."""

    reliability: Reliability = Reliability.RELIABLE
    durability: Durability = Durability.VOLATILE
    history: History = History.KEEP_LAST
    depth: int = DEFAULT_DEPTH
    deadline_ns: int = ENDLESS_NS
    lifespan_ns: int = ENDLESS_NS
    liveliness: Liveliness = Liveliness.AUTOMATIC
    lease_ns: int = ENDLESS_NS


SERVICES = Qos(depth=10)
"""Of services and clients, and of topics of which nothing else is said."""

DEFAULT = Qos()


def written_qos(qos: Qos) -> str:
    """A profile as a token has it."""
    return ":".join(
        (
            _written(qos.reliability, DEFAULT.reliability),
            _written(qos.durability, DEFAULT.durability),
            f"{_written(qos.history, DEFAULT.history)},{_written(qos.depth, DEFAULT_DEPTH)}",
            _duration(qos.deadline_ns),
            _duration(qos.lifespan_ns),
            f"{_written(qos.liveliness, DEFAULT.liveliness)},{_duration(qos.lease_ns)}",
        )
    )


def parse_qos(text: str) -> Qos | None:
    """A profile out of a token, None when it is none."""
    match = _QOS.fullmatch(text)
    if match is None:
        return None
    reliability, durability, history, depth, liveliness = (
        match[name] for name in ("reliability", "durability", "history", "depth", "liveliness")
    )
    try:
        return Qos(
            reliability=Reliability(int(reliability or 0) or DEFAULT.reliability),
            durability=Durability(int(durability or 0) or DEFAULT.durability),
            history=History(int(history or 0) or DEFAULT.history),
            depth=int(depth) if depth else DEFAULT_DEPTH,
            deadline_ns=_read(match["deadline_s"], match["deadline"]),
            lifespan_ns=_read(match["lifespan_s"], match["lifespan"]),
            liveliness=Liveliness(int(liveliness or 0) or DEFAULT.liveliness),
            lease_ns=_read(match["lease_s"], match["lease"]),
        )
    except ValueError:  # a number that is none of its enum's
        return None


_N = "[0-9]{0,20}"
_QOS = re.compile(
    rf"(?P<reliability>\d?):(?P<durability>\d?):(?P<history>\d?),(?P<depth>{_N}):"
    rf"(?P<deadline_s>{_N}),(?P<deadline>{_N}):(?P<lifespan_s>{_N}),(?P<lifespan>{_N}):"
    rf"(?P<liveliness>\d?),(?P<lease_s>{_N}),(?P<lease>{_N})",
    re.ASCII,
)


def _written(value: int, default: int) -> str:
    return "" if value == default else str(int(value))


def _duration(ns: int) -> str:
    seconds, rest = divmod(ns, _SECOND)
    endless_s, endless = divmod(ENDLESS_NS, _SECOND)
    return f"{_written(seconds, endless_s)},{_written(rest, endless)}"


def _read(seconds: str, ns: str) -> int:
    endless_s, endless = divmod(ENDLESS_NS, _SECOND)
    return int(seconds or endless_s) * _SECOND + int(ns or endless)
