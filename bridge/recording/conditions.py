"""What robots say of themselves, as events: a robot's whole state when it has changed, and what of it has. Pure."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET

from bridge.recording.streams import CONTROL, DEADMAN, DROPS, STATUS, STOPS
from macs_zenoh.protocol.robot_state import NodeStatus, RobotStatus, added, counting_anew, tripped

STOP, DEAD_MAN = "stop", "deadman"
"""What a ring is written for."""
TRIGGERS = (STOP, DEAD_MAN)


class Event(NamedTuple):
    """Something that is recorded as JSON: on which channel, what, under which name it is the newest, and which trigger
    it is, if it is one."""

    channel: str
    value: dict[str, Any]
    keep: str = ""
    trigger: str = ""


class Condition:
    """One robot's."""

    def __init__(self, robot: int) -> None:
        self._robot = robot
        self._last: RobotStatus | None = None
        self._stable: object = None

    def began_again(self) -> None:
        """The robot has been started again: it counts from none, and whatever it says has happened since."""
        if self._last is not None:
            self._last, self._stable = counting_anew(self._last), None

    def tell(self, status: RobotStatus) -> list[Event]:
        """The robot says how it is now: what is new in it. Times that only run on are not."""
        stable = _stable(status)
        if stable == self._stable:
            return []
        before, self._last, self._stable = self._last, status, stable
        events = [self._event(STATUS, {"status": msgspec.to_builtins(status)}, keep="status")]
        events += self._stops(before, status)
        events += self._controls(before, status)
        events += self._deadmen(before, status)
        events += self._drops(before, status)
        return events

    def _stops(self, before: RobotStatus | None, now: RobotStatus) -> list[Event]:
        was = (before.stopped, before.stop.times, before.stop.pressed) if before else (False, now.stop.times, [])
        if was == (now.stopped, now.stop.times, now.stop.pressed):
            return []
        value = {
            "stopped": now.stopped,
            "by": now.stop.by,
            "pressed": now.stop.pressed,
            "times": now.stop.times,
            "history": now.stop.history,
        }
        is_new = added(was[1], now.stop.times) > 0 or (now.stopped and not was[0])
        return [self._event(STOPS, value, keep="stop", trigger=STOP if is_new and before is not None else "")]

    def _controls(self, before: RobotStatus | None, now: RobotStatus) -> list[Event]:
        had, has = _holders(before) if before is not None else {}, _holders(now)
        return [
            self._event(
                CONTROL, {"topic": topic, "holder": has.get(topic), "before": had.get(topic)}, keep=f"control {topic}"
            )
            for topic in {**had, **has}
            if had.get(topic) != has.get(topic)
        ]

    def _deadmen(self, before: RobotStatus | None, now: RobotStatus) -> list[Event]:
        """Those that have acted since. Of what was before the first look nobody knows when: it is in the state."""
        if before is None:
            return []
        known = tripped(before)
        return [
            self._event(DEADMAN, {"topic": topic, "trips": told.times, "why": told.why}, trigger=DEAD_MAN)
            for topic, told in tripped(now).items()
            if added(known[topic].times if topic in known else 0, told.times)
        ]

    def _drops(self, before: RobotStatus | None, now: RobotStatus) -> list[Event]:
        was = before.drops if before is not None else {}
        more = {name: count for name, all_ in now.drops.items() if (count := added(was.get(name, 0), all_))}
        return [self._event(DROPS, {"more": more, "in_all": now.drops})] if more else []

    def _event(self, channel: str, value: dict[str, Any], *, keep: str = "", trigger: str = "") -> Event:
        name = f"{channel} {self._robot} {keep}" if keep else ""
        return Event(channel, {"robot": self._robot, **value}, name, trigger)


def stop_topic(status: RobotStatus) -> str:
    """The topic of a robot's emergency stop; empty for none."""
    return next((node.name for node in status.nodes if node.role == "emergency stop"), "")


def _holders(status: RobotStatus) -> dict[str, str]:
    """By topic, who has control."""
    return {node.name: holder for node in status.nodes if (holder := _holder(node))}


def _holder(node: NodeStatus) -> str | None:
    return node.control.holder if node.control is not UNSET else None


def _stable(status: RobotStatus) -> object:
    """What of a state is no time that runs."""
    nodes = []
    for node in status.nodes:
        deadman = node.deadman if node.deadman is not UNSET else None
        goals = node.goals if node.goals is not UNSET else []
        nodes.append(
            (
                node.role,
                node.name,
                node.type,
                sorted(node.registrants),
                _holder(node),
                (deadman.silence_s, deadman.commander, deadman.trips, deadman.last) if deadman else None,
                [(goal.goal, goal.status, goal.owner, goal.finished) for goal in goals],
            )
        )
    stop = status.stop
    told = (stop.by, stop.pressed, stop.times)
    return (status.ros_node, status.stopped, told, nodes, status.drops, status.trips, status.ros_domain)
