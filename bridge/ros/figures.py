"""What a robot tells who watches it: figures, whether it is ready, and why not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET

from bridge.metrics.families import Family, counter, gauge
from bridge.metrics.watched import Watched

if TYPE_CHECKING:
    from bridge.ros.agent import RobotAgent


MOST_TOPICS = 12
"""Rows of figures that have a topic each."""


def watched(current: Callable[[], RobotAgent | None]) -> Watched:
    """A robot as who watches it sees it. ``current`` is its agent now, None while it joins the mesh."""

    def of(read: Callable[[RobotAgent], Any], otherwise: Any) -> Callable[[], Any]:
        def read_now() -> Any:
            robot = current()
            return otherwise if robot is None else read(robot)

        return read_now

    return Watched(
        "agent",
        of(lambda robot: robot.agent.mesh, None),
        figures=of(_figures, ()),
        lost=of(lambda robot: {"robot": dict(robot.nodes.drops), "agent": dict(robot.agent.drops)}, {}),
        problems=of(_problems, ["it is not on the mesh yet"]),
        facts=of(lambda robot: {"robot": robot.agent.id, "status": msgspec.json.decode(robot.state())}, {}),
        directory=of(lambda robot: robot.agent.directory, None),
    )


def _problems(robot: RobotAgent) -> list[str]:
    wants = robot.nodes.robot.rules.settings.stop_topic
    return ["its emergency stop cannot be had"] if wants and robot.nodes.stop is None else []


def _figures(robot: RobotAgent) -> Iterator[Family]:
    stop = robot.nodes.robot.stop
    yield gauge("macs_robot_stopped", "whether the emergency stop holds").add(stop.stopped)
    yield counter("macs_robot_stops", "emergency stops").add(stop.times)
    nodes = gauge("macs_robot_nodes", "interface nodes by what they are")
    registrants = gauge("macs_robot_registrants", "registrations of agents on interface nodes")
    trips = counter("macs_robot_deadman_trips", "how often a dead-man has acted")
    controlled = gauge("macs_robot_controlled_topics", "topics over which an agent has control").add(0)
    calls = gauge("macs_robot_open_calls", "service calls that have no answer yet").add(0)
    goals = gauge("macs_robot_running_goals", "goals that actions work on").add(0)
    messages = counter("macs_topic_messages", "messages of a topic: out to the mesh, in to ROS")
    carried = counter("macs_topic_bytes", "their bytes of CDR")
    for topic, (times, _) in robot.nodes.robot.trips.all().items():
        trips.add(times, topic=topic)
    for node in robot.nodes:
        status = node.status()
        nodes.add(1, role=status.role)
        registrants.add(len(status.registrants), role=status.role)
        if status.control is not UNSET and status.control.holder:
            controlled.add(1)
        if status.open_calls is not UNSET:
            calls.add(status.open_calls)
        if status.goals is not UNSET:
            goals.add(sum(not goal.finished for goal in status.goals))
        if status.carried is not UNSET:
            direction = "out" if status.role == "subscriber" else "in"
            messages.add(status.carried.messages, topic=status.name, direction=direction)
            carried.add(status.carried.bytes, topic=status.name, direction=direction)
    yield from (nodes, registrants, trips.bounded(MOST_TOPICS), controlled, calls, goals)
    yield from (messages.bounded(MOST_TOPICS), carried.bounded(MOST_TOPICS))
