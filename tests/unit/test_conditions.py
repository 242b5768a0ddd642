"""`bridge.recording.conditions`: what robots say of themselves, as events."""

from __future__ import annotations

from typing import Any

from bridge.recording.conditions import DEAD_MAN, STOP, Condition, Event
from bridge.recording.streams import CONTROL, DEADMAN, DROPS, STATUS, STOPS
from macs_zenoh.protocol.robot_state import (
    ControlStatus,
    DeadManStatus,
    NodeStatus,
    RobotStatus,
    StopStatus,
    TripsStatus,
)

CMD = "/cmd_vel"


def status(*nodes: NodeStatus, **told: Any) -> RobotStatus:
    return RobotStatus("/rosagent", told.pop("stopped", False), told.pop("stop", StopStatus()), list(nodes), **told)


def driven(by: str | None, trips: int = 0) -> NodeStatus:
    return NodeStatus(
        "publisher",
        CMD,
        "geometry_msgs/Twist",
        control=ControlStatus(by),
        deadman=DeadManStatus(0.5, by, trips, "silence"),
    )


def told(*states: RobotStatus) -> list[Event]:
    """What is new in the last of several looks, but for the whole state."""
    condition = Condition(7)
    looks = [condition.tell(state) for state in states]
    assert all(event.value["robot"] == 7 for look in looks for event in look)
    return [event for event in looks[-1] if event.channel != STATUS]


def test_nothing_is_said_twice() -> None:
    """A state that is as it was is no news, and times that run on are none."""
    assert told(status(driven("unity/1")), status(driven("unity/1"))) == []
    first, later = (StopStatus(by="unity/1", pressed=["unity/1"], times=1, seconds=each) for each in (1.0, 2.0))
    assert told(status(stop=first, stopped=True), status(stop=later, stopped=True)) == []


def test_control_is_followed_to_its_end() -> None:
    """Who has it, who takes it over, and that nobody has it any more when its node has gone."""
    for before, now, said in (
        (status(), status(driven("unity/1")), ("unity/1", None)),
        (status(driven("unity/1")), status(driven("unity/2")), ("unity/2", "unity/1")),
        (status(driven("unity/1")), status(driven(None)), (None, "unity/1")),
        (status(driven("unity/1")), status(), (None, "unity/1")),
    ):
        (event,) = told(before, now)
        assert (event.channel, event.value["topic"]) == (CONTROL, CMD)
        assert (event.value["holder"], event.value["before"]) == said


def test_a_dead_man_is_told_once() -> None:
    """Whether its node is there or has gone, and of a robot that has been started again; not what was before."""
    acted = {CMD: TripsStatus(1, "unity/1 left")}
    for before, now in (
        (status(trips={}), status(trips=acted)),
        (status(driven(None)), status(driven(None, trips=1))),
        (status(trips={CMD: TripsStatus(5, "before")}), status(trips=acted)),
    ):
        (event,) = told(before, now)
        assert (event.channel, event.value["topic"], event.trigger) == (DEADMAN, CMD, DEAD_MAN)
    assert told(status(trips=acted)) == []
    assert told(status(trips=acted), status(trips=acted, drops={"stopped": 1}))[0].channel == DROPS


def test_what_was_lost_is_told_by_how_much() -> None:
    """What has been added; of a robot that has been started again all that it has."""
    for before, now, more in (
        ({}, {"a": 2}, {"a": 2}),
        ({"a": 2}, {"a": 5, "b": 1}, {"a": 3, "b": 1}),
        ({"a": 5}, {"a": 1}, {"a": 1}),
    ):
        (event,) = told(status(drops=before), status(drops=now))
        assert (event.channel, event.value["more"], event.value["in_all"]) == (DROPS, more, now)


def test_a_robot_that_was_started_again_counts_from_none() -> None:
    """Though it may have come to the same numbers: what they say has happened since."""
    before = status(
        driven("unity/1"), stop=StopStatus(by="unity/1", times=1), drops={"a": 1}, trips={CMD: TripsStatus(1)}
    )
    condition = Condition(7)
    condition.tell(before)
    assert condition.tell(before) == []
    condition.began_again()
    now = condition.tell(before)
    assert [event.channel for event in now] == [STATUS, STOPS, DEADMAN, DROPS]
    assert [event.trigger for event in now] == ["", STOP, DEAD_MAN, ""]
    assert condition.tell(before) == []


def test_a_stop_has_a_ring_written_once() -> None:
    """When it is pressed, not when another presses as well, nor when it was there at the first look."""
    free = status()
    stopped = status(stop=StopStatus(by="unity/1", pressed=["unity/1"], times=1), stopped=True)
    both = status(stop=StopStatus(by="unity/1", pressed=["unity/1", "unity/2"], times=1), stopped=True)
    assert [(event.channel, event.trigger) for event in told(free, stopped)] == [(STOPS, STOP)]
    assert [(event.channel, event.trigger) for event in told(stopped, both)] == [(STOPS, "")]
    assert [(event.channel, event.trigger) for event in told(stopped)] == [(STOPS, "")]
