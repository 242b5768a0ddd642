"""`macs rmw-zenoh --all`: robots by rule, as their nodes come and go."""

from __future__ import annotations

from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from bridge.rmw_zenoh.robots import Robots
from bridge.settings.rmw_zenoh import RmwZenohRobot, RmwZenohSettings
from macs_zenoh import ros
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Node
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)


def node(domain: int, namespace: str = "/") -> Node:
    return Node(domain, "ab", 0, "/", namespace, "talker")


def places(robots: list[RmwZenohRobot]) -> dict[int, tuple[int, str]]:
    """By id, where they are."""
    return {robot.id: (robot.domain, robot.node_namespace) for robot in robots}


def test_ids_stay() -> None:
    """Whoever comes and goes in between, a robot has the id that it had."""
    robots = Robots(RmwZenohSettings(first_id=100))
    assert places(robots.look([node(5)])) == {105: (5, "/")}
    assert places(robots.look([node(5), node(0), node(6, "/robot7/arm")])) == {
        105: (5, "/"),
        100: (0, "/"),
        7: (6, "/robot7"),
    }
    assert 7 in places(robots.look([]))
    assert places(robots.look([node(1, "/other7")]))[7] == (6, "/robot7")
    assert robots.refused == {(1, "/other7"): "id 7 is that of domain 6, namespace /robot7"}


def test_namespaces_take_the_place_of_their_domain() -> None:
    """A domain whose nodes are in namespaces with numbers is those robots; without them it is one again."""
    robots = Robots(RmwZenohSettings())
    assert places(robots.look([node(0)])) == {1: (0, "/")}
    assert places(robots.look([node(0), node(0, "/robot7")])) == {7: (0, "/robot7")}
    assert places(robots.look([node(0)])) == {1: (0, "/"), 7: (0, "/robot7")}


def test_robots_of_the_settings_stay() -> None:
    """They have their ids first, also where their nodes come last."""
    given = RmwZenohRobot(id=7, domain=3)
    robots = Robots(RmwZenohSettings(robots=[given]))
    assert robots.look([node(0, "/robot7")]) == [given]
    assert robots.look([node(3), node(3, "/robot8")])[0] is given


@pytest.mark.parametrize("place", [(233, "/"), (1_000_000, "/robot7"), (0, "/robot0"), (0, "/robot65536")])
def test_what_is_no_robot(place: tuple[int, str]) -> None:
    """Domains and ids that there are not."""
    robots = Robots(RmwZenohSettings())
    assert robots.look([node(*place)]) == []
    assert list(robots.refused) == [place]


def test_there_are_not_too_many() -> None:
    """Whoever has nodes in more namespaces than that has no more robots, and costs no more memory."""
    robots = Robots(RmwZenohSettings())
    found = robots.look([node(0, f"/robot{number}") for number in range(1, 3 * Robots.MAX)])
    assert len(found) == len(robots.refused) == Robots.MAX


async def test_robots_that_come_later() -> None:
    """One that was there at the start, one that comes, goes and is back, and a domain that becomes two robots."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        router = await enter(Router())
        agent = await enter(macs_zenoh.join("unity", id=300, connect=[router.endpoint]))
        await enter(ros.node("early", domain=40, connect=[router.endpoint]))
        program = await enter(Program("rmw-zenoh", "--all", "-e", router.endpoint))
        assert program.ready == "robot 41 (domain 40)"

        async def online(*ids: int) -> None:
            await until(lambda: agent.directory.ids(1) == list(ids), PATIENCE_S)

        await online(41)
        for _ in range(2):
            async with ros.node("late", domain=43, connect=[router.endpoint]):
                await online(41, 44)
            await online(41)
        async with (
            ros.node("one", domain=43, namespace="/robot7", connect=[router.endpoint]),
            ros.node("other", domain=43, namespace="/robot8", connect=[router.endpoint]),
        ):
            await online(7, 8, 41)
        await online(41)
