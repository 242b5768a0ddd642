"""Latched topics on real ROS publishers: every registrant gets what they hold, once, whenever it registers."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String

from bridge.ros.interface import Registrant, Robot
from bridge.ros.latched import Newcomers, Told
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import Metadata, StreamData, decode_management
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.wire import parse_frame
from tests.ros import unity_serializer
from tests.support.ros_peer import Peer, adding, removing
from tests.support.waiting import until


def latched(depth: int = 1, **more: Any) -> QoSProfile:
    """What a publisher offers that holds so many messages."""
    return QoSProfile(depth=depth, durability=DurabilityPolicy.TRANSIENT_LOCAL, **more)


class Got:
    """What each headset gets, with how often."""

    def __init__(self) -> None:
        self.texts: dict[int, Counter[str]] = {}
        self.data: dict[int, list[bytes]] = {}
        self._loop = asyncio.get_running_loop()

    def put(self, node: str, data: bytes) -> None:
        self._loop.call_soon_threadsafe(self._got, data)

    def _got(self, data: bytes) -> None:
        frame = parse_frame(data)
        management = decode_management(frame.management)
        assert isinstance(management, StreamData)
        for agent in management.dest_agents.get("2", []):
            self.data.setdefault(agent, []).append(bytes(frame.body))
            if b"/String" in bytes(frame.metadata):
                text = deserialize_message(bytes(frame.body), String).data
                self.texts.setdefault(agent, Counter())[text] += 1

    def of(self, agent: int) -> Counter[str]:
        return self.texts.get(agent, Counter())


@pytest.fixture
async def got() -> Got:
    return Got()


RULES = Rules(RobotSettings(rules=[TopicRule(match="/live", durability="volatile")]))


@pytest.fixture
async def nodes(session: RosSession, got: Got) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, got.put, rules=RULES))
    yield nodes
    nodes.close()


async def publish(peer: Peer, topic: str, *texts: str, qos: QoSProfile | None = None) -> Any:
    """A publisher that says these."""
    publisher = await peer.publisher(String, topic, qos or latched())
    for text in texts:
        publisher.publish(String(data=text))
    return publisher


async def knows(nodes: InterfaceNodes, topic: str, publishers: int) -> None:
    """Wait until the robot sees so many publishers."""
    await until(lambda: nodes.robot.session.node.count_publishers(topic) == publishers)


async def test_one_that_registers_later_gets_it_too(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """The second and the tenth headset get the map once; the first is not told twice; news goes to all, once."""
    publisher = await publish(peer, "/map", "map")
    await knows(nodes, "/map", 1)
    await nodes.add(adding("/map"))
    await until(lambda: got.of(5) == {"map": 1})
    for agent in range(6, 16):
        await nodes.add(adding("/map", registrant=agent))
        await nodes.add(adding("/map", registrant=agent))  # as a gateway repeats it
    await until(lambda: all(got.of(agent) == {"map": 1} for agent in range(5, 16)))
    publisher.publish(String(data="news"))
    await until(lambda: all(got.of(agent) == {"map": 1, "news": 1} for agent in range(5, 16)))
    await nodes.add(adding("/map", registrant=20))
    await until(lambda: got.of(20) == {"news": 1})
    assert all(got.of(agent) == {"map": 1, "news": 1} for agent in range(5, 16))


async def test_who_comes_and_goes_costs_few_subscriptions(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """A headset that registers and takes that back without end makes the robot subscribe a few times more and no
    oftener; others get what is held all the same."""
    await publish(peer, "/map", "map")
    await knows(nodes, "/map", 1)
    await nodes.add(adding("/map"))
    await until(lambda: got.of(5) == {"map": 1})
    session, most = nodes.robot.session, 0
    for _ in range(60):
        await nodes.add(adding("/map", registrant=6))
        nodes.remove(removing("/map", registrant=6))
        most = max(most, await session.run(lambda: session.node.count_subscribers("/map")))
    await nodes.add(adding("/map", registrant=7))
    await until(lambda: got.of(7) == {"map": 1})
    assert most <= 1 + Newcomers.AT_ONCE
    assert got.of(5) == {"map": 1}


@pytest.mark.parametrize("buffer_size", [1, 10])
async def test_each_publisher_tells_a_late_one(nodes: InterfaceNodes, got: Got, peer: Peer, buffer_size: int) -> None:
    """Of three publishers on /tf_static each has its message told, whatever room the headset asks for."""
    for text in ("camera", "lidar", "arm"):
        await publish(peer, "/tf_static", text)
    await knows(nodes, "/tf_static", 3)
    for agent in (5, 6):
        await nodes.add(adding("/tf_static", registrant=agent, buffer_size=buffer_size))
        await until(lambda agent=agent: got.of(agent) == {"camera": 1, "lidar": 1, "arm": 1})
    assert got.of(5) == {"camera": 1, "lidar": 1, "arm": 1}


async def test_a_late_one_gets_as_many_as_are_held(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """The last three of five, for one that asked for three; in the order in which they were said."""
    await publish(peer, "/log", *"abcde", qos=latched(5))
    await knows(nodes, "/log", 1)
    for agent in (5, 6):
        await nodes.add(adding("/log", registrant=agent, buffer_size=3))
        await until(lambda agent=agent: {"c", "d", "e"} <= set(got.of(agent)))
    assert [deserialize_message(data, String).data for data in got.data[6]][-3:] == ["c", "d", "e"]


async def test_a_publisher_that_does_not_latch_takes_nothing_away(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """With one of each kind on a topic, early and late headsets get what the one that latches holds."""
    await publish(peer, "/mixed", "held")
    other = await publish(peer, "/mixed", "gone", qos=QoSProfile(depth=1))
    await knows(nodes, "/mixed", 2)
    for agent in (5, 6):
        await nodes.add(adding("/mixed", registrant=agent))
        await until(lambda agent=agent: got.of(agent) == {"held": 1})
    await until(lambda: other.get_subscription_count() >= 1)
    other.publish(String(data="live"))
    await until(lambda: got.of(5) == got.of(6) == {"held": 1, "live": 1})


async def test_a_publisher_that_comes_later_is_heard_once(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """Whatever is on the topic already, what a publisher says in its first moment reaches everybody, once."""
    for agent in (5, 6):
        await nodes.add(adding("/map", registrant=agent))
    await publish(peer, "/map", "first")
    await until(lambda: got.of(5) == got.of(6) == {"first": 1})
    plain = await publish(peer, "/map", qos=QoSProfile(depth=1))
    await until(lambda: "plain" in got.of(6) or plain.publish(String(data="plain")))
    await publish(peer, "/map", "third")
    await until(lambda: all({"first", "third", "plain"} <= set(got.of(agent)) for agent in (5, 6)))
    await nodes.add(adding("/map", registrant=7))
    await until(lambda: {"first", "third"} <= set(got.of(7)))
    assert [(got.of(agent)["first"], got.of(agent)["third"]) for agent in (5, 6, 7)] == [(1, 1)] * 3


@pytest.mark.parametrize("vanishes", [True, False])
async def test_one_that_comes_back_gets_it_again(nodes: InterfaceNodes, got: Got, peer: Peer, vanishes: bool) -> None:
    """A headset that left and registers again starts anew; the one that stayed does not notice."""
    await publish(peer, "/map", "map")
    await knows(nodes, "/map", 1)
    for agent in (5, 6):
        await nodes.add(adding("/map", registrant=agent))
        await until(lambda agent=agent: got.of(agent) == {"map": 1})
    for again in (2, 3):
        if vanishes:
            nodes.forget(Registrant(2, 5))
        else:
            nodes.remove(removing("/map"))
        await nodes.add(adding("/map"))
        await until(lambda again=again: got.of(5) == {"map": again})
    assert got.of(6) == {"map": 1}


async def test_a_latched_best_effort_topic_is_told(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """Both kinds of reliability on one latched topic: a late one gets what the reliable one holds."""
    await publish(peer, "/map", "map")
    await publish(peer, "/map", qos=latched(reliability=ReliabilityPolicy.BEST_EFFORT))
    await knows(nodes, "/map", 2)
    await nodes.add(adding("/map"))
    await nodes.add(adding("/map", registrant=6))
    await until(lambda: got.of(6)["map"] <= 1)


async def test_a_rule_can_ask_for_news_only(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """With durability = "volatile" in a rule nobody is told of before."""
    publisher = await publish(peer, "/live", "before")
    await knows(nodes, "/live", 1)
    for agent in (5, 6):
        await nodes.add(adding("/live", registrant=agent))
    await until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data="news"))
    await until(lambda: got.of(5) == got.of(6) == {"news": 1})


async def test_the_emergency_stop_is_told_to_late_ones(nodes: InterfaceNodes, got: Got) -> None:
    """Each headset that registers on the stop's own topic learns whether the robot is stopped."""
    await nodes.open_stop("/emergency_stop")
    await knows(nodes, "/emergency_stop", 1)
    states = []
    for agent, stop in ((5, None), (6, True), (7, None), (8, False)):
        if stop is not None:
            cdr = unity_serializer.write(Bool(data=stop))
            nodes.deliver(Message("unity", 5, Metadata(2, 5, node_type=2, node_name="nd__emergency_stop"), cdr))
            await until(lambda stop=stop: got.data[5][-1][4] == stop)
        await nodes.add(adding("/emergency_stop", "std_msgs/Bool", registrant=agent))
        await until(lambda agent=agent: agent in got.data)
        states.append(got.data[agent][0][4])
    assert states == [0, 1, 1, 0]
    assert [len(got.data[agent]) for agent in (5, 6, 7, 8)] == [3, 2, 2, 1]


async def test_both_kinds_of_headsets_can_read_it(nodes: InterfaceNodes, got: Got, peer: Peer) -> None:
    """A JointState with positions only deafens no existing headset, live or held, and newer ones get ROS's own."""
    state = JointState(name=["a"], position=[1.0])
    publisher = await peer.publisher(JointState, "/joints", latched())
    publisher.publish(state)
    await knows(nodes, "/joints", 1)
    for agent, unity in ((5, True), (6, False), (7, True), (8, False)):
        more = {"unity_cdr": True} if unity else {}
        await nodes.add(adding("/joints", "sensor_msgs/JointState", registrant=agent, **more))
        await until(lambda agent=agent: len(got.data.get(agent, ())) == 1)
    publisher.publish(state)
    await until(lambda: all(len(got.data[agent]) == 2 for agent in (5, 6, 7, 8)))
    for agent in (5, 7):
        assert [unity_serializer.read(JointState, data) for data in got.data[agent]] == [state] * 2
    for agent in (6, 8):
        assert [deserialize_message(data, JointState) for data in got.data[agent]] == [state] * 2


async def test_the_second_subscription_ends(
    nodes: InterfaceNodes, got: Got, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is there for a moment; a busy topic does not keep it."""
    monkeypatch.setattr(Newcomers, "QUIET_S", 0.5)
    publisher = await publish(peer, "/map", "map")
    await knows(nodes, "/map", 1)
    for agent in (5, 6, 7):
        await nodes.add(adding("/map", registrant=agent))
    await until(lambda: got.of(7) == {"map": 1})
    await until(lambda: publisher.get_subscription_count() == 1)
    await nodes.add(adding("/map", registrant=8))
    nodes.close()
    await until(lambda: publisher.get_subscription_count() == 0)


def test_who_was_told_is_remembered_and_bounded() -> None:
    """Nobody is told twice, unless he left, or more has been said since than is kept."""
    told, five, six = Told(), Registrant(2, 5), Registrant(2, 6)
    assert told.to_tell((1, 1), frozenset({five})) == {five}
    assert told.to_tell((1, 1), frozenset({five, six})) == {six}
    assert told.to_tell((1, 2), frozenset({five})) == {five}
    told.forget(five)
    assert told.to_tell((1, 1), frozenset({five, six})) == {five}
    for number in range(Told.KEPT):
        told.to_tell((2, number), frozenset())
    assert told.to_tell((1, 1), frozenset({five, six})) == {five, six}
