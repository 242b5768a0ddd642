"""What a robot says of itself is read as it was written, and by who is older or newer as well."""

from __future__ import annotations

import msgspec
import pytest

from macs_zenoh.protocol.robot_state import (
    ControlStatus,
    GoalStatus,
    NodeStatus,
    Offered,
    RobotStatus,
    StopStatus,
    TopicQos,
    release,
    released,
)

STATUS = RobotStatus(
    ros_node="/macs_robot_7",
    stopped=True,
    stop=StopStatus("unity/5", ["unity/5"], 2.5, 3, ["stopped by unity/5"]),
    nodes=[
        NodeStatus("publisher", "/cmd_vel", "geometry_msgs/Twist", ["unity/5"], control=ControlStatus("unity/5", 1.0)),
        NodeStatus("service client", "/set", "std_srvs/SetBool", [], open_calls=0),
        NodeStatus("action client", "/go", "x/Go", [], goals=[GoalStatus("00", 2, "unity/5")]),
    ],
    drops={"no_node": 1},
    ros_domain=0,
)


def test_a_status_is_read_as_it_was_written() -> None:
    """Robot and command line have the same structs, so nothing is lost between them."""
    assert msgspec.json.decode(msgspec.json.encode(STATUS), type=RobotStatus) == STATUS


def test_a_node_tells_what_it_has() -> None:
    """A node without control, calls and goals has no word of them; one that has no calls just now says none."""
    subscriber = NodeStatus("subscriber", "/pose", "geometry_msgs/Pose", [])
    assert msgspec.to_builtins(subscriber) == {
        "role": "subscriber",
        "name": "/pose",
        "type": "geometry_msgs/Pose",
        "registrants": [],
    }
    assert msgspec.to_builtins(STATUS)["nodes"][1]["open_calls"] == 0
    assert set(msgspec.to_builtins(STATUS.nodes[0])) == {"role", "name", "type", "registrants", "control"}


def test_newer_and_older_robots_are_understood() -> None:
    """What a newer robot has besides is ignored, what an older one does not say has its default."""
    newer = {**msgspec.to_builtins(STATUS), "battery": 0.5}
    assert msgspec.convert(newer, RobotStatus) == STATUS
    older = {"ros_node": "/r", "stopped": False, "stop": {}, "nodes": []}
    assert msgspec.convert(older, RobotStatus).ros_domain is None


def test_offers_say_how_a_topic_is_sent() -> None:
    """Names with types, and for each topic what a subscription has to ask for."""
    offered = Offered(
        publishers={"/map": "nav_msgs/msg/OccupancyGrid"}, qos={"/map": TopicQos("reliable", "volatile")}
    )
    assert msgspec.json.decode(msgspec.json.encode(offered), type=Offered) == offered


@pytest.mark.parametrize(
    ("data", "means"),
    [
        (b"false", (True, None)),
        (release(0), (True, 0)),
        (release(17), (True, 17)),
        (b"true", (False, None)),
        (b"", (False, None)),
        (b"false x", (False, None)),
        (b"false -1", (False, None)),
        (b"false " + b"9" * 5000, (False, None)),
        (b"falsely", (False, None)),
    ],
)
def test_what_is_no_release_stops(data: bytes, means: tuple[bool, int | None]) -> None:
    """A number is read only if it is short; whatever is not understood is the safer of the two."""
    assert released(data) == means


def test_a_robot_that_counts_no_presses_is_told_the_word_alone() -> None:
    """One of before takes whatever else is said for a press."""
    before = msgspec.json.decode(b'{"by": "unity/5", "times": 1}', type=StopStatus)
    assert release(before.presses) == b"false"
