"""What happened in a recording, in words and by time: stops, dead-men, refusals, losses, who took control.

Of a file no more is read than the chunks that have such.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec

from bridge.recording.bag import Bag
from bridge.recording.streams import CONTROL, DEADMAN, DROPS, JSON, LOST, LOST_BEFORE, REFUSALS, STOPS

TEXT = 300
"""Characters of one: names and reasons come from the network."""


class Happened(NamedTuple):
    """One thing: when, in seconds after the recording's beginning and in ns since 1970; its kind; the robot, 0 for the
    recording itself; what, in words."""

    at_s: float
    time_ns: int
    kind: str
    robot: int
    text: str


def happened(bag: Bag) -> Iterator[Happened]:
    """All of it, by time; what cannot be read as JSON of ours is left out. Raises BadBag."""
    topics = {channel.id: channel.topic for channel in bag.channels.values() if channel.encoding == JSON}
    for message in bag.messages(lambda channel: channel.topic in _WORDS and channel.encoding == JSON):
        kind, words = _WORDS[topics[message.channel]]
        try:
            value = msgspec.json.decode(message.data)  # so that what is made of it can be written as JSON as well
            text, robot = words(value), _robot(value)
        except (msgspec.MsgspecError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            continue
        # what is repeated at the beginning of a file happened before
        time_ns = min(message.log_ns, message.publish_ns or message.log_ns)
        yield Happened((time_ns - bag.start_ns) / 1e9, time_ns, kind, robot, text[:TEXT])


def _robot(value: dict[str, Any]) -> int:
    robot = value.get("robot", value.get("robotId", value.get("robot_id", 0)))
    return robot if isinstance(robot, int) and 0 <= robot <= 0xFFFF else 0


def _stop(value: dict[str, Any]) -> str:
    return f"stopped by {value['by'] or 'somebody'}" if value["stopped"] else "released"


def _deadman(value: dict[str, Any]) -> str:
    return f"the dead-man of {value['topic']} acted: {value['why']}"


def _refusal(value: dict[str, Any]) -> str:
    topic = value.get("tosName", value.get("tos_name", value.get("topic", "")))
    return f"refused {value['to']} on {topic}: {value['reason']}"


def _drops(value: dict[str, Any]) -> str:
    return "lost or refused: " + _counts(value["more"])


def _lost(value: dict[str, Any]) -> str:
    return "the recording has lost in all: " + _counts(value["lost"])


def _lost_before(value: dict[str, Any]) -> str:
    return f"{value['more']} messages of {value['topic']} did not come to the recording, {value['in_all']} in all"


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items()))


def _control(value: dict[str, Any]) -> str:
    return f"{value['holder'] or 'nobody'} has control of {value['topic']}"


_WORDS: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    STOPS: ("stop", _stop),
    DEADMAN: ("deadman", _deadman),
    REFUSALS: ("refusal", _refusal),
    DROPS: ("loss", _drops),
    LOST: ("loss", _lost),
    LOST_BEFORE: ("loss", _lost_before),
    CONTROL: ("control", _control),
}
KINDS = tuple(dict.fromkeys(kind for kind, _ in _WORDS.values()))
