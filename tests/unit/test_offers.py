"""The type behind a topic's or service's name, as robots offer it."""

from __future__ import annotations

import pytest

from macs_zenoh.errors import Unreachable, UsageError
from macs_zenoh.protocol.messages import Functionality, NodeType
from macs_zenoh.protocol.offers import closest, short_type, type_behind

ROBOT = Functionality(
    subscribers={"/cmd_vel": "geometry_msgs/msg/Twist", "/both": "a_msgs/msg/In"},
    publishers={"/pose": "geometry_msgs/msg/PoseStamped", "/both": "a_msgs/msg/Out"},
    services={"/set": "std_srvs/srv/SetBool"},
)


@pytest.mark.parametrize(
    ("name", "kind", "of_type"),
    [
        ("/pose", NodeType.SUBSCRIBER, "geometry_msgs/PoseStamped"),
        ("pose", NodeType.SUBSCRIBER, "geometry_msgs/PoseStamped"),
        ("/cmd_vel", NodeType.PUBLISHER, "geometry_msgs/Twist"),
        ("/cmd_vel", NodeType.SUBSCRIBER, "geometry_msgs/Twist"),
        ("/both", NodeType.SUBSCRIBER, "a_msgs/Out"),
        ("/both", NodeType.PUBLISHER, "a_msgs/In"),
        ("/set", NodeType.CLIENT, "std_srvs/SetBool"),
    ],
)
def test_the_type_is_that_of_the_other_end(name: str, kind: NodeType, of_type: str) -> None:
    """Who subscribes means what is published, who publishes what is subscribed; else what is there."""
    assert type_behind(name, kind, [Functionality(), ROBOT]) == of_type


def test_what_nobody_offers_is_guessed_at() -> None:
    """A name that is nearly one is told; nothing that is not alike."""
    with pytest.raises(Unreachable, match=r"topic /pos .*did you mean /pose\?"):
        type_behind("/pos", NodeType.SUBSCRIBER, [ROBOT])
    with pytest.raises(Unreachable, match=r"service /x cannot be reached: no robot offers it\. Or say its type"):
        type_behind("/x", NodeType.CLIENT, [ROBOT])
    with pytest.raises(Unreachable):
        type_behind("/pose", NodeType.SUBSCRIBER, [])
    assert closest("/x", []) == ""


def test_several_types_have_to_be_told_apart() -> None:
    """Robots that disagree are named with their types."""
    other = Functionality(publishers={"/pose": "geometry_msgs/msg/Pose"})
    with pytest.raises(UsageError, match="geometry_msgs/Pose and geometry_msgs/PoseStamped"):
        type_behind("/pose", NodeType.SUBSCRIBER, [ROBOT, other])


def test_a_type_is_written_short() -> None:
    """As headsets write it, whatever form it came in."""
    assert short_type("std_msgs/msg/String") == short_type("std_msgs/String") == "std_msgs/String"
