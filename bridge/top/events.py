"""What changes on a mesh, one thing at a time: who came and left, what was stopped, who has control. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from msgspec import UNSET

from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.robot_state import RobotStatus, added, tripped

SHORT = 8
"""Of a session's id so much tells it from others."""

REFUSALS = {
    "stopped": "the emergency stop holds",
    "not_in_control": "another agent has control",
    "not_allowed": "they may not act on this robot",
    "too_old": "they had waited too long",
    "bad_cdr": "they are no messages of their type",
    "refused_by_manager": "its manager did not take them",
}
"""Drops of a robot that mean that it did not do what somebody wanted, and why."""


TURNED_AWAY = {
    "NotAdmitted": "no valid token was shown",
    "NotPermitted": "their token gives no right to it",
    "NotAllowed": "they spoke for others",
    "address_not_allowed": "they come from a network that may not",
    "too_many_connections": "there are too many connections",
    "too_many_from_address": "there are too many connections of one address",
    "too_many_ids": "one address has most of the ids of the gateway's blocks",
    "too_many_unknown": "there are too many that have shown no token",
    "robot_not_allowed": "robot programs may not come with that id",
    "zenoh_program": "they are Zenoh programs, which want a router",
    "other_page": "another web page asked",
}
"""Drops of a gateway that mean that it turned somebody away, and why."""
HARMLESS = frozenset({"wrong_sender", "nobody_with_this_id"})
"""What existing programs do all day."""


class Event(NamedTuple):
    """One thing that happened. ``what`` is one of `KINDS`, ``who`` whom it is about, ``text`` a line for people."""

    at_s: float
    """Seconds since 1970."""
    what: str
    who: str
    text: str
    by: str = ""

    def facts(self) -> dict[str, str | float]:
        """For programs."""
        said: dict[str, str | float] = {"time": round(self.at_s, 3), "event": self.what, "who": self.who}
        return {**said, **({"by": self.by} if self.by else {}), "text": self.text}


KINDS = (
    "came",
    "left",
    "moved",
    "group",
    "stopped",
    "released",
    "control",
    "refused",
    "dead-man",
    "registered",
    "lost",
    "silent",
)


def of_presence(before: AgentInfo | None, after: AgentInfo | None, at_s: float) -> Iterator[Event]:
    """What became of one agent: it came, left, is in another group, or behind another gateway."""
    if before is None and after is not None:
        group = f" in group {after.group}" if after.group else ""
        yield Event(at_s, "came", str(after.key), f"{after.key} is online{group} (session {after.zid[:SHORT]})")
    elif before is not None and after is None:
        yield Event(at_s, "left", str(before.key), f"{before.key} has left")
    elif before is not None and after is not None:
        if before.group != after.group:
            group = f"in group {after.group}" if after.group else "in no group"
            yield Event(at_s, "group", str(after.key), f"{after.key} is {group} now")
        if before.zid != after.zid:
            text = f"{after.key} has failed over to session {after.zid[:SHORT]} (from {before.zid[:SHORT]})"
            yield Event(at_s, "moved", str(after.key), text)


def of_program(kind: str, name: str, there: bool, at_s: float) -> Event:
    """A gateway or a router came or went."""
    who = f"{kind} {name}"
    return Event(at_s, "came" if there else "left", who, f"{who} {'is there' if there else 'has gone'}")


def of_robot(robot: int, before: RobotStatus, after: RobotStatus, at_s: float) -> Iterator[Event]:
    """What happened on a robot between two looks at its state."""
    who = str(AgentId(1, robot))
    yield from _stops(who, before, after, at_s)
    yield from _controls(who, before, after, at_s)
    had, has = _registered(before), _registered(after)
    for agent, role, topic in sorted(has - had):
        yield Event(at_s, "registered", who, f"{agent} has registered as {role} of {topic} on {who}", agent)
    for name, count in _more(before.drops, after.drops).items():
        if name in REFUSALS:
            yield Event(at_s, "refused", who, f"{who} refused {_messages(count)}: {REFUSALS[name]} ({name})")
        else:
            yield Event(at_s, "lost", who, f"{who} lost {_messages(count)} ({name})")


def of_gateway(name: str, before: Mapping[str, int], after: Mapping[str, int], at_s: float) -> Iterator[Event]:
    """What a gateway refused and lost between two looks."""
    who = f"gateway {name}"
    for counter, count in _more(before, after).items():
        why = TURNED_AWAY.get(counter)
        if why is not None:
            yield Event(at_s, "refused", who, f"{who} refused {count}: {why} ({counter})")
        elif counter not in HARMLESS:
            yield Event(at_s, "lost", who, f"{who} lost {_messages(count)} ({counter})")


def _stops(who: str, before: RobotStatus, after: RobotStatus, at_s: float) -> Iterator[Event]:
    if after.stopped and (not before.stopped or after.stop.times != before.stop.times):
        yield Event(at_s, "stopped", who, f"{who} was stopped by {after.stop.by}", after.stop.by)
    elif before.stopped and not after.stopped:
        by = after.stop.by or "being started again"
        yield Event(at_s, "released", who, f"{who} was released by {by}", after.stop.by)
    elif added(before.stop.times, after.stop.times):  # both between two looks
        yield Event(at_s, "stopped", who, f"{who} was stopped, and released by {after.stop.by}", after.stop.by)


def _controls(who: str, before: RobotStatus, after: RobotStatus, at_s: float) -> Iterator[Event]:
    had, has = _holders(before), _holders(after)
    for topic in sorted(had.keys() | has.keys()):
        if (holder := has.get(topic)) != had.get(topic):
            text = f"{holder} has control of {topic} on {who}" if holder else f"nobody has control of {topic} on {who}"
            yield Event(at_s, "control", who, text, holder or "")
    had_tripped = tripped(before)
    for topic, told in tripped(after).items():
        if added(had_tripped[topic].times if topic in had_tripped else 0, told.times):
            yield Event(at_s, "dead-man", who, f"the dead-man of {topic} on {who} has acted: {told.why}")


def _holders(status: RobotStatus) -> dict[str, str]:
    return {
        node.name: node.control.holder for node in status.nodes if node.control is not UNSET and node.control.holder
    }


def _registered(status: RobotStatus) -> set[tuple[str, str, str]]:
    return {(agent, node.role, node.name) for node in status.nodes for agent in node.registrants}


def _more(before: Mapping[str, int], after: Mapping[str, int]) -> Counter[str]:
    return Counter({name: more for name, count in after.items() if (more := added(before.get(name, 0), count))})


def _messages(count: int) -> str:
    return "1 message" if count == 1 else f"{count} messages"
