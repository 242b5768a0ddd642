"""What a headset's user is told when nothing comes, or nobody hears."""

from __future__ import annotations

import pytest

from bridge.headset.hints import Role, judge
from macs_zenoh.protocol.messages import Functionality

OFFERED = Functionality(
    publishers={"/chatter": "std_msgs/msg/String", "/scan": "sensor_msgs/msg/LaserScan"},
    subscribers={"/cmd_vel": "geometry_msgs/msg/Twist"},
)


@pytest.mark.parametrize(
    ("topic", "role", "said"),
    [
        ("/chatter", "publishers", ""),
        ("chatter", "publishers", ""),
        ("/chater", "publishers", "robot 1 offers no publisher of /chater; did you mean /chatter?"),
        ("chater", "publishers", "robot 1 offers no publisher of /chater; did you mean /chatter?"),
        ("/odometry", "publishers", "robot 1 offers no publisher of /odometry"),
        ("/cmd_vel", "publishers", "robot 1 offers no publisher of /cmd_vel"),
        ("/cmd_vel", "subscribers", ""),
        ("/cmdvel", "subscribers", "robot 1 offers no subscriber to /cmdvel; did you mean /cmd_vel?"),
        ("/for_other_headsets", "subscribers", ""),
    ],
)
def test_hints(topic: str, role: Role, said: str) -> None:
    assert judge(1, topic, role, OFFERED) == said


@pytest.mark.parametrize("role", ["publishers", "subscribers"])
def test_a_robot_in_an_empty_graph(role: Role) -> None:
    """Most often it is in the wrong domain."""
    assert judge(1, "/chatter", role, Functionality()) == (
        "robot 1 offers nothing at all; is its ROS_DOMAIN_ID that of its nodes?"
    )
