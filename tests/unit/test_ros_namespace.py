"""Who may use the keys of a robot's ROS nodes, where its sessions have a namespace."""

from __future__ import annotations

import pytest
import zenoh

from bridge.security import access, policy
from bridge.settings import parse
from macs_zenoh.errors import ConfigError

POLICY = """
routers: [{name: site, addresses: [site.example.org]}]
robots:
  - {name: robot-7, id: 7, ros_namespace: robot7}
  - {name: robot-8, id: 8, ros_namespace: robot8}
gateways: [{name: hall, blocks: [1]}]
permissions: [{who: all, may: all, whom: all}]
"""
KEYS = (
    "robot7/0/pose/geometry_msgs::msg::dds_::Pose_/RIHS01_ab",
    "robot7/@ros2_lv/0/ab/0/0/NN/%/%/talker",
    "robot7/0/map/std_msgs::msg::dds_::String_/RIHS01_ab/@adv/pub/ab/1/_",
)


def may(found: list[access.Rule], key: str) -> bool:
    return any(zenoh.KeyExpr(allowed).includes(key) for rule in found for allowed in rule.keys)


@pytest.mark.parametrize("key", KEYS)
def test_keys_below_a_namespace_are_one_robots(key: str) -> None:
    """Its own certificate may all there, nobody else's anything; routers pass it on to each other."""
    given = policy.parse(POLICY)
    allowed = {client.name for client in given.clients if may(access.rules(given, client), key)}
    assert allowed == {"robot-7"}
    assert may(access.link_rules(given), key)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (("robot8", "robot7"), "ros_namespace robot7 is robot-7's already"),
        (("robot8", "macs"), "macs is the mesh's own"),
        (("robot8", "a/b"), "ros_namespace"),
    ],
)
def test_namespaces_that_would_be_somebody_elses(change: tuple[str, str], problem: str) -> None:
    """Each robot has its own, and none is the mesh's."""
    with pytest.raises(ConfigError, match=problem):
        policy.parse(POLICY.replace(*change))


def test_the_settings_say_so() -> None:
    """What is written for the robot has `macs rmw-zenoh` use the namespace."""
    from bridge.security.files import _sections

    given = policy.parse(POLICY)
    (robot,) = parse("\n".join(_sections(given, given.robots[0], "there"))).rmw_zenoh.robots
    assert (robot.id, robot.session_namespace) == (7, "robot7")
