"""Traffic rules and priorities of topics on a real robot: what leaves it, and at which priority."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable

import pytest
import zenoh
from std_msgs.msg import String
from zenoh import Priority

import macs_zenoh
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings, TopicRule
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import encode_data
from macs_zenoh.sections import changed
from tests.support.ros_peer import Peer, adding, removing
from tests.support.waiting import PATIENCE_S, until

ROBOT = 7

SETTINGS = Settings(
    robot=RobotSettings(
        id=ROBOT,
        rules=[
            TopicRule(match="/camera/left", priority="interactive_low"),
            TopicRule(match="/camera/*", priority="background"),
        ],
    ),
    traffic=[TrafficRule(match="macs/from/**", priority="data_low"), TrafficRule(match="**/nd__fast", max_hz=20)],
)


class Seen:
    """Every sample of the robot's streams as Zenoh has it: key and priority."""

    def __init__(self, endpoint: str) -> None:
        config = zenoh.Config()
        for path, value in (
            ("mode", '"client"'),
            ("connect/endpoints", json.dumps([endpoint])),
            ("scouting/multicast/enabled", "false"),
        ):
            config.insert_json5(path, value)
        self.samples: list[tuple[str, Priority]] = []
        self.session = zenoh.open(config)
        self._subscriber = self.session.declare_subscriber(
            STREAM.every(type=1, id=ROBOT), zenoh.handlers.Callback(self._take, indirect=False)
        )

    def _take(self, sample: zenoh.Sample) -> None:
        self.samples.append((str(sample.key_expr), sample.priority))

    def count(self, node: str) -> int:
        return sum(1 for key, _ in self.samples if key == STREAM.of(type=1, id=ROBOT, node=node))

    async def after(self, publish: Callable[[], None], node: str) -> Priority:
        """The priority of a node's message, published again and again until one arrives."""
        self.samples.clear()

        def again() -> bool:
            publish()
            return self.count(node) > 0

        await until(again)
        return next(priority for key, priority in self.samples if key.endswith("/" + node))


@pytest.fixture
async def seen(router: str) -> AsyncIterator[Seen]:
    seen = await asyncio.to_thread(Seen, router)
    yield seen
    await asyncio.to_thread(seen.session.close)


@pytest.fixture
async def headset(router: str, domain: int) -> AsyncIterator[Agent]:
    """Headset 5, which knows of a robot with the settings above."""
    settings = changed(SETTINGS, mesh=MeshSettings(connect=[router]))
    async with (
        open_robot(settings, domain_id=domain),
        macs_zenoh.join("unity", id=5, connect=[router]) as headset,
    ):
        await until(lambda: (1, ROBOT) in headset.directory)
        yield headset


async def test_a_topic_has_the_priority_that_its_rule_says(headset: Agent, seen: Seen, peer: Peer) -> None:
    """A topic's data travels at the priority of the first rule for it, before any traffic rule for its key; a topic
    without one as the traffic rules say."""
    for topic, node, priority in (
        ("/camera/left", "nd__camera_left", Priority.INTERACTIVE_LOW),
        ("/camera/right", "nd__camera_right", Priority.BACKGROUND),
        ("/pose", "nd__pose", Priority.DATA_LOW),
    ):
        await headset.call("ros", ROBOT, "add_node", encode_data(adding(topic)))
        publisher = await peer.publisher(String, topic, matched=1)
        assert await seen.after(lambda publisher=publisher: publisher.publish(String()), node) == priority


async def test_a_node_name_that_is_used_again_takes_no_priority_along(headset: Agent, seen: Seen, peer: Peer) -> None:
    """A topic whose node has the name of an earlier one with a priority travels at its own."""
    for topic, priority in (("/camera/left", Priority.INTERACTIVE_LOW), ("/camera_left", Priority.DATA_LOW)):
        await headset.call("ros", ROBOT, "add_node", encode_data(adding(topic)))
        publisher = await peer.publisher(String, topic, matched=1)
        publish = lambda publisher=publisher: publisher.publish(String())  # noqa: E731
        assert await seen.after(publish, "nd__camera_left") == priority
        await headset.call("ros", ROBOT, "remove_node", encode_data(removing(topic)))


async def test_a_topic_above_its_rate_is_counted(headset: Agent, seen: Seen, peer: Peer) -> None:
    """Of a topic that is faster than its key may be, each message leaves the robot or is counted in its status."""
    for topic in ("/pose", "/fast"):
        await headset.call("ros", ROBOT, "add_node", encode_data(adding(topic, buffer_size=200)))
    pose = await peer.publisher(String, "/pose", matched=1)
    fast = await peer.publisher(String, "/fast", 200, matched=1)
    await seen.after(lambda: pose.publish(String()), "nd__pose")  # so the router knows of our subscription

    async def dropped() -> int:
        status = json.loads(await headset.call("ros", ROBOT, "status"))
        return int(status["drops"].get("over_rate", 0))

    async def all_accounted_for() -> None:
        while seen.count("nd__fast") + await dropped() < 100:
            await asyncio.sleep(0.01)

    for _ in range(100):
        fast.publish(String())
    await asyncio.wait_for(all_accounted_for(), PATIENCE_S)
    assert seen.count("nd__fast") + await dropped() == 100
    assert await dropped() >= 50
