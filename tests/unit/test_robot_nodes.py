"""What an existing robot program may be told."""

from __future__ import annotations

from typing import Any

import pytest

from macs_zenoh.errors import Refused
from macs_zenoh.protocol.limits import NODES_EACH
from macs_zenoh.protocol.messages import ROS, UNITY, AddNode, Functionality, GoneAgent, RemoveNode, node_name
from macs_zenoh.protocol.robot_nodes import RobotNodes


def node(topic: str = "/a", kind: int = 1, type_: str = "std_msgs/String", agent: int = 5, **fields: Any) -> AddNode:
    """A registration of headset 5."""
    fields = {"node_name": node_name(topic), **fields}
    return AddNode(UNITY, agent, kind, fields.pop("node_name"), topic, type_, **fields)


def removal(added: AddNode) -> RemoveNode:
    """The end of a registration."""
    return RemoveNode(added.registrant_agent_type, added.registrant_agent_id, added.node_type, added.node_name)


def test_a_registration_is_told_once() -> None:
    """Repeated in whatever way it is not told again; another registrant is; after its end it is told anew."""
    nodes = RobotNodes()
    assert nodes.add(node())
    assert not nodes.add(node())
    assert not nodes.add(node(buffer_size=3, drop_new=True))
    assert nodes.add(node(agent=6))
    assert nodes.registrants() == [GoneAgent(UNITY, 5), GoneAgent(UNITY, 6)]
    assert nodes.remove(removal(node()))
    assert not nodes.remove(removal(node()))
    assert nodes.add(node())
    nodes.gone([GoneAgent(UNITY, 5), GoneAgent(ROS, 6), GoneAgent(UNITY, 77)])
    assert nodes.registrants() == [GoneAgent(UNITY, 6)]
    nodes.gone([GoneAgent(UNITY, 6)])
    assert nodes.find(1, "nd__a") is None


def test_nobody_takes_all_of_a_robots_nodes() -> None:
    """One agent has no more than its gateway would let it have, and what is left last is for those who have few."""
    nodes = RobotNodes()
    for agent in range(3):
        for number in range(NODES_EACH):
            nodes.add(node(f"/a{agent}_{number}", agent=agent))
        with pytest.raises(Refused, match=f"unity/{agent} has 1024 interface nodes on this robot; the rest is for"):
            nodes.add(node("/one_more", agent=agent))
    for number in range(NODES_EACH):
        nodes.add(node(f"/b{number}", agent=1000 + number))
    with pytest.raises(Refused, match="this robot has 4096 interface nodes"):
        nodes.add(node("/one_more", agent=7))
    nodes.gone([GoneAgent(UNITY, 1)])
    assert nodes.add(node("/one_more", agent=7))


def test_names_that_collide() -> None:
    """Two topics with one node name, or one topic with two types, are refused to whoever comes second."""
    nodes = RobotNodes()
    nodes.add(node("/a/b"))
    with pytest.raises(Refused, match="/a_b and /a/b have the same node name nd__a_b"):
        nodes.add(node("/a_b", agent=6))
    with pytest.raises(Refused, match="/a/b is registered with type std_msgs/String, not std_msgs/Bool"):
        nodes.add(node("/a/b", type_="std_msgs/Bool"))
    nodes.remove(removal(node("/a/b")))
    assert nodes.add(node("/a_b", agent=6))


def test_a_service_of_headsets_has_one() -> None:
    """A second registrant on a node of type 4 is refused with the holder's name, until that one has left."""
    nodes = RobotNodes()
    assert nodes.add(node(kind=4, type_="std_srvs/SetBool"))
    assert not nodes.add(node(kind=4, type_="std_srvs/SetBool"))
    other = node(kind=4, type_="std_srvs/SetBool", agent=6)
    with pytest.raises(Refused, match="registered by another agent, unity/5"):
        nodes.add(other)
    nodes.gone([GoneAgent(UNITY, 5)])
    assert nodes.add(other)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (node(kind=5), "no nodes of type 5"),
        (node(kind=0), "no nodes of type 0"),
        (node(kind=9), "no nodes of type 9"),
        (node(node_name="nd__b"), "is called nd__a"),
        (node(node_name="x" * 70_000), "is called nd__a"),
        (node("/a b"), "no name that ROS takes"),
        (node(""), "no name that ROS takes"),
        (node("/"), "no name that ROS takes"),
        (node("/a//b"), "no name that ROS takes"),
        (node("/a/"), "no name that ROS takes"),
        (node("/9a"), "no name that ROS takes"),
        (node("~a"), "no name that ROS takes"),
        (node("/a\n"), "no name that ROS takes"),
        (node("/" + "a" * 300), "no name that ROS takes"),
        (node(buffer_size=1 << 70), "a buffer of more than 65535"),
        (node(type_="os/path"), "not how a type is written"),
        (node(type_="os/Path"), "a module of Python"),
        (node(type_="subprocess/Popen"), "a module of Python"),
        (node(type_="std_msgs/msg/String"), "not how a type is written"),
        (node(type_="String"), "not how a type is written"),
        (node(type_=""), "not how a type is written"),
        (node(type_="../x/Y"), "not how a type is written"),
        (node(type_="std_msgs/NoSuch"), "no message type NoSuch in std_msgs"),
        (node(type_="std_srvs/SetBool"), "no message type SetBool in std_srvs"),
        (node(kind=3), "no service type String in std_msgs"),
        (node(type_="no_such_pkg/Foo"), "names no type of no_such_pkg"),
    ],
)
def test_what_a_robot_does_not_survive(wrong: AddNode, why: str) -> None:
    """Types, names and kinds of nodes that end an existing robot's thread are refused with the reason."""
    nodes = RobotNodes()
    with pytest.raises(Refused, match=why):
        nodes.add(wrong)
    assert nodes.registrants() == []


def test_what_a_robot_has_passes() -> None:
    """Types of packages that the robot or its settings name, and of common ones; names as ROS takes them."""
    nodes = RobotNodes(["my_msgs"])
    for topic in ("a", "~/pose", "/camera/image_raw", "/" + "a" * 246):
        assert nodes.add(node(topic, type_="my_msgs/Thing2"))
    assert nodes.add(node("/map", type_="nav_msgs/OccupancyGrid"))
    assert nodes.add(node("/t", type_="its_msgs/B"), Functionality(subscribers={"/u": "its_msgs/msg/A"}))
    assert nodes.add(node("/v", type_="std_msgs/Newer"), Functionality(publishers={"/v": "std_msgs/msg/Newer"}))
    assert nodes.add(node("/s", 4, "std_srvs/Newer"), Functionality(services={"/x": "std_srvs/srv/Newer"}))
