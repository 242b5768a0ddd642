"""Robots in each other's graphs: topics and services that one has of the others, by `[[robot.mirror]]`."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import SetBool

from bridge.ros.agent import RobotAgent
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from bridge.settings.mirror import MirrorRule
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, Refused
from macs_zenoh.protocol.messages import AddNode, NodeType, node_name
from tests.support.programs import Program
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get, until

PAGE = Path(__file__).parents[2] / "docs" / "robots-together.md"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@asynccontextmanager
async def robot(router: str, number: int, domain: int, *rules: MirrorRule) -> AsyncIterator[RobotAgent]:
    settings = Settings(
        mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=number, group=3, mirror=list(rules))
    )
    async with open_robot(settings, domain_id=domain) as agent:
        yield agent


@asynccontextmanager
async def peer(domain: int, name: str = "peer") -> AsyncIterator[Peer]:
    made = Peer(domain, name)
    try:
        yield made
    finally:
        made.session.close()


async def test_a_topic_of_another_robot(router: str, domain: int) -> None:
    """What robot 1 publishes is in robot 2's graph under its name there, with its QoS, also for a node that comes
    later; when robot 1 goes, its topic goes."""
    there, here = domain, domain + 100
    rule = MirrorRule(source="ros/1", topics=["/pose", "/map"], name="/robot1{topic}")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        other, own = await enter(peer(there)), await enter(peer(here))
        second = await enter(robot(router, 2, here, rule))
        poses = await own.subscription(String, "/robot1/pose")
        first = AsyncExitStack()
        await first.enter_async_context(robot(router, 1, there))
        publisher = await other.publisher(String, "/pose")
        held = await other.publisher(String, "/map", LATCHED)
        held.publish(String(data="hall"))

        async def heard() -> bool:
            publisher.publish(String(data="here"))
            return not poses.empty()

        await until(heard, PATIENCE_S)
        assert poses.get_nowait().data == "here"
        maps = await own.subscription(String, "/robot1/map", LATCHED)
        assert (await get(maps)).data == "hall"
        offered = await second.offers.now()
        assert "/robot1/pose" not in {**offered.publishers, **offered.subscribers}
        name = "/robot1/pose"
        with pytest.raises(Refused, match="not open"):
            await second.nodes.add(AddNode(2, 300, NodeType.SUBSCRIBER, node_name(name), name, "std_msgs/String"))
        await first.aclose()
        await own.sees("/robot1/pose", publishers=0, subscriptions=1)


async def test_a_service_of_another_robot(router: str, domain: int) -> None:
    """A node of robot 2 calls a service of robot 1; without an answer it hears why."""
    there, here = domain, domain + 100
    rule = MirrorRule(source="group/3", services=["/lamp"], name="/robot{robot}{topic}")

    def switch(request: Any, response: Any) -> Any:
        response.success, response.message = request.data, "switched"
        return response

    async with peer(there) as other, peer(here) as own, robot(router, 1, there), robot(router, 2, here, rule):
        await other.session.run(lambda: other.session.node.create_service(SetBool, "/lamp", switch))
        client = await own.session.run(lambda: own.session.node.create_client(SetBool, "/robot1/lamp"))
        await until(client.service_is_ready, PATIENCE_S)
        loop = asyncio.get_running_loop()
        answers: asyncio.Queue[Any] = asyncio.Queue()

        def answered(future: Any) -> None:
            loop.call_soon_threadsafe(answers.put_nowait, future.result())

        def ask() -> None:
            client.call_async(SetBool.Request(data=True)).add_done_callback(answered)

        await own.session.run(ask)
        answer = await get(answers)
        assert (answer.success, answer.message) == (True, "switched")


async def test_robots_that_mirror_each_other(router: str, domain: int) -> None:
    """Three robots with each other's poses: each message is there once, and nothing comes back."""
    domains = [domain, domain + 60, domain + 120]
    rules = [MirrorRule(source="group/3", topics=["/pose"], name="/robot{robot}{topic}")]
    async with AsyncExitStack() as stack:
        peers = [await stack.enter_async_context(peer(each)) for each in domains]
        for number, each in enumerate(domains, start=1):
            await stack.enter_async_context(robot(router, number, each, *rules))
        publishers = [await each.publisher(String, "/pose") for each in peers]
        heard = {
            (here, there): await peers[here - 1].subscription(String, f"/robot{there}/pose")
            for here in (1, 2, 3)
            for there in (1, 2, 3)
            if here != there
        }

        async def all_heard() -> bool:
            for publisher in publishers:
                publisher.publish(String(data="begin"))
            return not any(queue.empty() for queue in heard.values())

        await until(all_heard, PATIENCE_S, every_s=0.05)
        for publisher in publishers:
            publisher.publish(String(data="end"))
        for queue in heard.values():
            while (await get(queue)).data != "end":
                pass
        for first in range(0, 100, 5):  # fewer than a topic keeps, so that nothing has to be thrown away
            numbers = range(first, first + 5)
            for number in numbers:
                for there, publisher in enumerate(publishers, start=1):
                    publisher.publish(String(data=f"{there} {number}"))
            for (_, there), queue in heard.items():
                assert [(await get(queue)).data for _ in numbers] == [f"{there} {number}" for number in numbers]
        assert all(queue.empty() for queue in heard.values())
        topics = dict(await peers[0].session.run(peers[0].session.node.get_topic_names_and_types))
        assert not [name for name in topics if name.count("robot") > 1 or name == "/robot1/pose"]


async def test_the_page_s_three_robots(router: str, domain: int, tmp_path: Path) -> None:
    """Programs with the settings of docs/robots-together.md, as it starts them: robot 1 hears robot 2's poses."""
    example = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)[-1]
    settings = tmp_path / "robots.toml"
    settings.write_text(example, encoding="utf-8")
    domains = [domain, domain + 60, domain + 120]
    async with AsyncExitStack() as stack:
        for number, each in enumerate(domains, start=1):
            arguments = ("agent", "--id", str(number), "--settings", str(settings), "-e", router)
            await stack.enter_async_context(Program(*arguments, env={"ROS_DOMAIN_ID": str(each)}))
        first, second = [await stack.enter_async_context(peer(each)) for each in domains[:2]]
        heard = await first.subscription(String, "/robot2/pose")
        publisher = await second.publisher(String, "/pose")

        def comes() -> bool:
            publisher.publish(String(data="here"))
            return not heard.empty()

        await until(comes, PATIENCE_S, every_s=0.05)
        assert heard.get_nowait().data == "here"


@pytest.mark.parametrize(
    "wrong",
    [{"name": "/robot1"}, {"name": "{topic}"}, {"source": "unity/1"}, {"topics": ["pose"]}, {"name": "x{topic}"}],
)
def test_rules_that_make_no_sense(wrong: dict[str, Any]) -> None:
    """A mirror under the same name, or without one, is a mistake that is told."""
    with pytest.raises(ConfigError):
        MirrorRule(**{"source": "ros/1", "topics": ["/pose"], **wrong})
