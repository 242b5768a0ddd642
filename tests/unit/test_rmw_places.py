"""Which id a place of a robot's nodes has: the same, whichever was seen first."""

from __future__ import annotations

from bridge.rmw_zenoh.robots import Robots
from bridge.settings.rmw_zenoh import RmwZenohRobot, RmwZenohSettings
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Node


def node(domain: int, namespace: str = "/") -> Node:
    return Node(domain, "ab", 0, "/", namespace, "talker")


def places(robots: list[RmwZenohRobot]) -> dict[int, tuple[int, str]]:
    """By id, where they are."""
    return {robot.id: (robot.domain, robot.node_namespace) for robot in robots}


def test_a_domain_yields_its_id_to_its_namespaces() -> None:
    """A node without a namespace that is seen first does not keep robot 1 away."""
    robots = Robots(RmwZenohSettings())
    first, fleet = node(0), [node(0, "/robot1"), node(0, "/robot2")]
    assert places(robots.look([first])) == {1: (0, "/")}
    both = {1: (0, "/robot1"), 2: (0, "/robot2")}
    assert places(robots.look([first, *fleet])) == both
    assert robots.refused == {}
    assert places(robots.look([first])) == both
    assert robots.refused == {(0, "/"): "id 1 is that of domain 0, namespace /robot1"}


def test_another_domain_yields_its_id_as_well() -> None:
    """In either order the name's number decides, and the domain without a robot is told of."""
    for order in ([node(6)], [node(0, "/robot7")], [node(6), node(0, "/robot7")]):
        robots = Robots(RmwZenohSettings())
        robots.look(order)
        assert places(robots.look([node(6), node(0, "/robot7")])) == {7: (0, "/robot7")}
        assert robots.refused == {(6, "/"): "id 7 is that of domain 0, namespace /robot7"}


def test_what_is_no_robot_takes_no_id() -> None:
    """A number of a domain that there is not, and one that the settings give to somebody, change nothing."""
    given = RmwZenohRobot(id=1, domain=0)
    for settings in (RmwZenohSettings(), RmwZenohSettings(robots=[given])):
        robots = Robots(settings)
        assert robots.look([node(0)]) == [given]
        assert robots.look([node(0), node(233, "/robot1")]) == [given]
    assert robots.look([node(0), node(0, "/robot1")]) == [given]
