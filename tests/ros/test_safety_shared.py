"""One emergency stop for all agents on one ROS graph, and for ROS nodes that press it."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Bool

from bridge.ros.safety import EmergencyStop
from bridge.ros.shared_stop import A_NODE
from macs_zenoh import join
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused
from tests.ros.driven import STOPPED, driving, hear, may_command, send_bool, site, told
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, until

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# -- pure ------------------------------------------------------------------------------------------------------------


def test_who_presses_again_is_counted_again() -> None:
    """A press by who has pressed already is one that a release may not have seen; copies of a press are none."""
    stop = EmergencyStop()
    counts = []
    for at in (0.0, 0.3, 1.5, 1.6, 2.9):
        stop.press("unity/1", at)
        counts.append(stop.presses)
    assert counts == [1, 1, 2, 2, 3]
    stop.take_back("unity/1", 3.0)
    stop.press("unity/1", 3.1)
    assert stop.presses == 4


AGENTS = 3
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["press", "release", "take back", "hear"]), st.integers(0, AGENTS - 1), st.integers(0, 4)
    ),
    max_size=40,
)


@given(STEPS)
def test_agents_that_share_a_stop_agree_and_fall_silent(steps: list[tuple[str, int, int]]) -> None:
    """Whatever happens to whom in which order, as soon as all have heard all they agree, and nobody says more."""
    stops = [EmergencyStop() for _ in range(AGENTS)]
    waiting: list[list[deque[tuple[int, list[str], str]]]] = [[deque() for _ in stops] for _ in stops]
    said = 0

    def tell(number: int) -> None:
        nonlocal said
        said += 1
        for other in range(AGENTS):
            if other != number:
                waiting[other][number].append((stops[number].changes, list(stops[number].pressed), stops[number].by))

    def hear_one(number: int, sender: int) -> None:
        if waiting[number][sender] and stops[number].adopt(*waiting[number][sender].popleft(), 0.0):
            tell(number)

    for step, number, who in steps:
        stop, before = stops[number], stops[number].changes
        if step == "hear":
            hear_one(number, who % AGENTS)
            continue
        act = {"press": stop.press, "release": stop.release, "take back": stop.take_back}[step]
        act(f"unity/{who}", 0.0)
        if stop.changes != before:
            tell(number)
    limit = said + 100 * (len(steps) + 1)
    while any(queue for queues in waiting for queue in queues):
        for number in range(AGENTS):
            for sender in range(AGENTS):
                hear_one(number, sender)
        assert said < limit, "they tell each other without end"
    assert len({(stop.changes, tuple(sorted(stop.pressed))) for stop in stops}) == 1


def test_of_two_at_once_the_stop_wins() -> None:
    """One agent is released in the moment in which the other is stopped: both end stopped."""
    one, other = EmergencyStop(), EmergencyStop()
    one.press("a", 0)
    other.adopt(one.changes, one.pressed, one.by, 0)
    one.release("operator/5", 1)
    other.press("b", 1)
    one_says, other_says = (one.changes, one.pressed, one.by), (other.changes, other.pressed, other.by)
    one.adopt(*other_says, 2)
    other.adopt(*one_says, 2)
    assert one.stopped
    assert other.stopped


def said(stop: EmergencyStop) -> dict[str, Any]:
    """What it tells others, and `hear` takes."""
    return {
        "changes": stop.changes,
        "pressed": list(stop.pressed),
        "by": stop.by,
        "session": stop.session,
        "own": dict(stop.own),
        "heard": dict(stop.heard),
    }


def hear_all(*stops: EmergencyStop) -> None:
    """Tell each other until nobody has anything new."""
    for _ in range(10):
        told = [said(stop) for stop in stops]
        news = [stop.adopt(**state, now=0) for stop in stops for state in told if state["session"] != stop.session]
        if not any(news):
            return
    raise AssertionError("they tell each other without end")


@pytest.mark.parametrize("released_before", [1, 5])
@pytest.mark.parametrize("they_hear_first", [True, False])
def test_a_stop_that_others_do_not_know_stays(released_before: int, they_hear_first: bool) -> None:
    """One that has just started, or was cut off, is stopped: what others have changed meanwhile releases nothing."""
    old, new = EmergencyStop(), EmergencyStop()
    for _ in range(released_before):
        old.press("a", 0)
        old.release("operator/5", 0)
    new.press("b", 1)
    told_before = said(old)
    if they_hear_first:
        old.adopt(**said(new), now=2)
        assert old.pressed == ["b"]
    new.adopt(**told_before, now=2)
    assert new.pressed == ["b"]
    hear_all(old, new)
    assert old.pressed == new.pressed == ["b"]
    assert old.release("operator/5", 3)  # and who knows it may release it
    new.adopt(**said(old), now=3)
    assert not new.stopped


def test_what_a_third_one_passed_on_is_known() -> None:
    """A release by who heard of a stop from another than where it was pressed, releases."""
    one, two, three = (EmergencyStop() for _ in range(3))
    one.press("a", 0)
    two.adopt(**said(one), now=1)
    three.adopt(**said(two), now=2)
    three.release("operator/5", 3)
    for stop in (one, two):
        stop.adopt(**said(three), now=4)
    assert not any(stop.stopped for stop in (one, two, three))


def test_an_agent_that_says_less_is_believed() -> None:
    """One of an older version releases what it was told of."""
    new, old = EmergencyStop(), EmergencyStop()
    new.press("a", 0)
    old.adopt(new.changes, new.pressed, new.by, 0)
    old.release("operator/5", 1)
    new.adopt(old.changes, old.pressed, old.by, 2)
    assert not new.stopped


def test_two_with_many_presses_fall_silent() -> None:
    """More than are remembered, and other ones: they need not agree on all names."""
    one, other = EmergencyStop(), EmergencyStop()
    for number in range(EmergencyStop.PRESSED + 1):
        one.press(f"unity/{number}", 0)
        other.press(f"unity/{1000 + number}", 0)
    hear_all(one, other)
    assert one.stopped
    assert other.stopped


CUT_OFF = st.lists(
    st.tuples(
        st.sampled_from(["press", "release", "take back", "hear", "lose"]),
        st.integers(0, AGENTS - 1),
        st.integers(0, 4),
    ),
    max_size=40,
)


@example([("press", 1, 1), ("hear", 0, 1), ("release", 0, 0), ("press", 1, 1)])
@given(CUT_OFF)
def test_agents_that_lose_what_others_said_agree_in_the_end(steps: list[tuple[str, int, int]]) -> None:
    """As soon as each hears what the others say now; and nobody's press is lost that no releasing agent knew."""
    stops = [EmergencyStop() for _ in range(AGENTS)]
    since_release = ""
    for at, (step, number, who) in enumerate(steps):
        stop, now = stops[number], 2.0 * at
        if step == "hear":
            stop.adopt(**said(stops[who % AGENTS]), now=now) if who % AGENTS != number else None
        elif step != "lose":
            {"press": stop.press, "release": stop.release, "take back": stop.take_back}[step](f"unity/{who}", now)
            since_release = f"unity/{who}" if step == "press" and stop.own.get(f"unity/{who}") == stop.changes else ""
    hear_all(*stops)
    assert len({(stop.stopped, tuple(sorted(stop.pressed))) for stop in stops}) == 1
    assert not since_release or since_release in stops[0].pressed, "the last of all that happened was a press"


# -- with processes --------------------------------------------------------------------------------------------------


async def stopped(agent: Agent, robot: int, wanted: bool = True) -> None:
    """Wait until a robot says that it is, or is not."""
    deadline = time.monotonic() + PATIENCE_S
    while (await told(agent, robot))["stopped"] is not wanted:
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)


async def test_a_stop_of_one_agent_holds_for_the_graph(domain: int, peer: Peer, tmp_path: Path) -> None:
    """Two agents drive one graph: what stops one stops the other, now and when it comes later; a release of either
    ends it for both."""
    heard = await hear(peer)
    async with site(domain, tmp_path) as place, place.headset() as driver, place.robot(1) as first:
        async with place.robot(2) as second:
            await may_command(driver, 2)
            async with driving(driver, 2):
                await until(lambda: heard.last == 0.5)
                await driver.call("ros", 1, "stop", b"true")
                await until(lambda: heard.last == STOPPED)
                await stopped(driver, 2)
                count = len(heard.values)
                await asyncio.sleep(0.5)
                assert len(heard.values) == count, "a command passed the other agent"
            others = (await told(driver, 2))["nodes"][0]["shared_with"]
            assert others == [1]
            await until(lambda: any("agent of robot 1 works on this ROS graph too" in line for line in second.log))
            await until(lambda: any("agent of robot 2 works on this ROS graph too" in line for line in first.log))
        async with place.robot(3):
            await stopped(driver, 3)
            await driver.call("ros", 3, "stop", b"false")  # by whoever stopped, at another agent
            await stopped(driver, 1, False)
            await stopped(driver, 3, False)
            assert (await told(driver, 1))["stop"]["times"] == 1


async def test_a_ros_node_stops_the_robot(domain: int, peer: Peer, tmp_path: Path) -> None:
    """A button on the robot: its true stops, now or before the agent came; its false releases nothing."""
    heard = await hear(peer)
    button = await peer.publisher(Bool, "/emergency_stop", LATCHED)
    async with site(domain, tmp_path) as place, place.headset() as driver:
        async with place.robot():
            await may_command(driver, 1)
            async with driving(driver, 1):
                await until(lambda: heard.last == 0.5)
                await peer.session.run(lambda: button.publish(Bool(data=True)))
                await until(lambda: heard.last == STOPPED)
                await peer.session.run(lambda: button.publish(Bool(data=False)))
                await asyncio.sleep(0.3)
                assert heard.last == STOPPED
            with pytest.raises(Refused, match="may not release what a ROS node stopped"):
                await driver.call("ros", 1, "stop", b"false")
            await peer.session.run(lambda: button.publish(Bool(data=True)))
        async with place.robot():
            await until(lambda: (1, 1) in driver.directory)
            await stopped(driver, 1)


async def test_a_stop_holds_when_its_node_ends_at_once(domain: int, peer: Peer, tmp_path: Path) -> None:
    """True on the topic, and the publisher is gone: ten of ten stops hold, however soon the robot looks who it was."""
    async with site(domain, tmp_path) as place, join("operator", id=5, settings=place.mesh) as operator, place.robot():
        await until(lambda: (1, 1) in operator.directory)
        for _ in range(10):
            button = await peer.publisher(Bool, "/emergency_stop", LATCHED, matched=1)
            await peer.session.run(lambda button=button: press_and_go(peer, button))
            await stopped(operator, 1)
            assert (await told(operator, 1))["stop"]["pressed"] == [A_NODE]
            await operator.call("ros", 1, "stop", b"false")
            assert not (await told(operator, 1))["stopped"]


def press_and_go(peer: Peer, button: Any) -> None:
    """What has not been acknowledged when its writer ends is lost in DDS."""
    button.publish(Bool(data=True))
    button.wait_for_all_acked(Duration(seconds=10))
    peer.session.node.destroy_publisher(button)


async def test_the_stop_of_a_node_holds_beside_that_of_a_headset(domain: int, peer: Peer, tmp_path: Path) -> None:
    """A button pressed while the robot is stopped counts: the headset that stopped before cannot take that back. What
    the agent says itself on the topic presses no button."""
    button = await peer.publisher(Bool, "/emergency_stop", LATCHED)
    async with site(domain, tmp_path) as place, place.robot(), place.headset() as headset:
        await until(lambda: (1, 1) in headset.directory)
        for _ in range(5):
            await headset.call("ros", 1, "stop", b"true")
            assert (await told(headset, 1))["stop"]["pressed"] == ["unity/300"]
            await headset.call("ros", 1, "stop", b"false")
        await headset.call("ros", 1, "stop", b"true")
        await until(lambda: button.get_subscription_count() >= 1)
        await peer.session.run(lambda: button.publish(Bool(data=True)))
        deadline = time.monotonic() + PATIENCE_S
        while (await told(headset, 1))["stop"]["pressed"] != ["unity/300", A_NODE]:
            assert time.monotonic() < deadline
        with pytest.raises(Refused, match="a ROS node stopped it as well"):
            await headset.call("ros", 1, "stop", b"false")


async def test_the_stop_of_a_headset_holds_when_it_leaves_at_once(domain: int, tmp_path: Path) -> None:
    """True on the topic, and the session ends: five of five stops hold, and nobody with its id takes them back."""
    async with site(domain, tmp_path) as place, join("operator", id=5, settings=place.mesh) as operator, place.robot():
        for _ in range(5):
            async with place.headset() as headset:
                await until(lambda headset=headset: (1, 1) in headset.directory)
                send_bool(headset, 1, True)
            await stopped(operator, 1)
            await until(lambda: (2, 300) not in operator.directory)
            async with place.headset() as another:
                await until(lambda another=another: (1, 1) in another.directory)
                with pytest.raises(Refused, match="may not release"):
                    await another.call("ros", 1, "stop", b"false")
            await operator.call("ros", 1, "stop", b"false")
