"""`macs rmw-zenoh` with robots made of zenoh-ros2-sdk: topics, services and latched topics, both ways."""

from __future__ import annotations

import asyncio
import importlib.util
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from typing import NamedTuple

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from bridge.headset.nodes import ServiceRequest
from macs_zenoh import ros
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Kind
from tests.support.programs import Program, macs
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until
from tests.support.workers import Worker

pytestmark = [
    pytest.mark.skipif(
        importlib.util.find_spec("zenoh_ros2_sdk") is None,
        reason="robots that others wrote need zenoh-ros2-sdk: pip install 'macs-zenoh[peers]'",
    ),
    pytest.mark.timeout(300),
]

DOMAIN = 31


class Site(NamedTuple):
    """A router, `macs rmw-zenoh` and a robot of the SDK's on it, and an agent that is a headset."""

    endpoint: str
    program: Program
    robot: Worker
    agent: Agent

    async def there(self, there: bool = True) -> None:
        """Wait until robot 7 is online, or is not."""
        await until(lambda: (self.agent.directory.ids(1) == [7]) is there, PATIENCE_S)


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Router())
        port = router.endpoint.rpartition(":")[2]
        arguments = ("rmw-zenoh", "--id", "7", "--group", "3", "--domain", str(DOMAIN), "-e", router.endpoint)
        program = await stack.enter_async_context(Program(*arguments))
        robot = await stack.enter_async_context(Worker("tests.support.sdk_robot", port, str(DOMAIN)))
        agent = await stack.enter_async_context(macs_zenoh.join("unity", id=300, connect=[router.endpoint]))
        yield Site(router.endpoint, program, robot, agent)


async def test_a_robot_is_there_while_its_nodes_are(site: Site) -> None:
    """Its first node brings it onto the mesh, with what it offers; a killed one takes it off."""
    assert site.agent.directory.ids(1) == []
    await site.robot.ask("publish", topic="/chatter", text="a")
    await site.there()
    await site.robot.ask("subscribe", topic="/orders")
    await site.robot.ask("serve_set_bool", name="/lights")

    async def offered() -> dict[str, dict[str, str]]:
        (robot,) = [each for each in await macs("ls", "-v", "--json", "-e", site.endpoint) if each["type"] == "ros"]
        return {kind: (robot.get("offers") or {}).get(kind, {}) for kind in ("publishers", "subscribers", "services")}

    expected = {
        "publishers": {"/chatter": "std_msgs/msg/String"},
        "subscribers": {"/orders": "std_msgs/msg/String"},
        "services": {"/lights": "std_srvs/srv/SetBool"},
    }

    async def complete() -> bool:
        return await offered() == expected

    await until(complete, PATIENCE_S)
    await site.robot.stop(9)
    await site.there(False)
    await site.robot.start()
    await site.robot.ask("publish", topic="/chatter", text="b")
    await site.there()


async def test_topics_both_ways(site: Site) -> None:
    """What the robot publishes comes to an agent that registered, also after the robot's program was killed; what the
    agent publishes comes to the robot."""
    await site.robot.ask("publish", topic="/chatter", text="first")
    await site.robot.ask("subscribe", topic="/orders")
    await site.there()
    heard = await site.agent.subscribe("/chatter", robot=7)
    texts: list[str] = []

    async def listen() -> None:
        async for message in heard:
            texts.append(message.value["data"])

    listening = asyncio.create_task(listen())

    async def hears(text: str) -> bool:
        await site.robot.ask("publish", topic="/chatter", text=text)
        return text in texts

    await until(lambda: hears("again"), PATIENCE_S)
    orders = await site.agent.advertise("/orders", robot=7)

    async def obeyed() -> list[str]:
        orders.publish({"data": "go"})
        found: list[str] = await site.robot.ask("heard", topic="/orders")
        return found

    assert set(await until(obeyed, PATIENCE_S)) == {"go"}
    await site.robot.stop(9)
    await site.there(False)
    await site.robot.start()
    await until(lambda: hears("back"), PATIENCE_S)
    listening.cancel()


async def test_several_take_one_topic(site: Site) -> None:
    """Two agents have it over one subscription in the robot's graph, which stays until the last of them leaves; and
    who looks at the robot is told what nobody can do for it."""
    await site.robot.ask("publish", topic="/chatter", text="first")
    await site.there()

    async def told() -> bool:
        (robot,) = [each for each in await macs("ls", "-v", "--json", "-e", site.endpoint) if each["type"] == "ros"]
        return "nobody stops it" in (robot["status"] or {}).get("beside", "")

    await until(told, PATIENCE_S)
    texts: dict[int, list[str]] = {300: [], 301: []}

    async def heard_by(text: str, *ids: int) -> bool:
        await site.robot.ask("publish", topic="/chatter", text=text)
        return all(text in texts[number] for number in ids)

    async with (
        macs_zenoh.join("unity", id=301, connect=[site.endpoint]) as other,
        ros.node("tool", domain=DOMAIN, connect=[site.endpoint]) as tool,
    ):
        await until(lambda: (1, 7) in other.directory)
        heard = {}
        for agent in (site.agent, other):
            heard[agent.id] = subscription = await agent.subscribe("/chatter", robot=7)
            subscription.on_message(lambda message, to=texts[agent.id]: to.append(message.value["data"]))

        def taken() -> int:
            return len(tool.network.graph(DOMAIN).on("/chatter", Kind.SUBSCRIPTION))

        await until(lambda: heard_by("both", 300, 301), PATIENCE_S)
        assert taken() == 1
        heard[300].close()
        await until(lambda: heard_by("one", 301), PATIENCE_S)
        assert taken() == 1
        heard[301].close()
        await until(lambda: taken() == 0, PATIENCE_S)


async def test_services_both_ways(site: Site) -> None:
    """An agent calls a service of the robot; the robot calls one of a headset."""
    await site.robot.ask("serve_set_bool", name="/lights")
    await site.there()
    answer = await site.agent.call_service("/lights", {"data": True}, robot=7)
    assert answer == {"success": True, "message": "sdk says True"}

    async def serve(request: ServiceRequest) -> bytes:
        return b"\0\1\0\0" + request.data[4:5] + b"\0\0\0\x03\0\0\0me\0"

    async with (
        Program("gateway", "--port", "0", "-e", site.endpoint) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as headset,
    ):

        async def there() -> bool:
            return 7 in (await headset.online()).ros_agent_ids

        await until(there, PATIENCE_S)
        await headset.serve("/ask", "std_srvs/SetBool", serve, agents=[7])

        async def answered() -> bool:
            return await site.robot.ask("call_set_bool", name="/ask", data=True) == [True, "me"]

        await until(answered, PATIENCE_S)


async def test_the_graph_tells_the_truth(site: Site) -> None:
    """What agents have registered is what the robot's own tools show: a subscription, with its type."""
    await site.robot.ask("publish", topic="/chatter", text="first")
    await site.there()
    await site.agent.advertise("/orders", robot=7, type="std_msgs/String")

    async def shown() -> bool:
        return (await site.robot.ask("topics")).get("/orders") == ["std_msgs/msg/String"]

    await until(shown, PATIENCE_S)


async def test_a_dry_run_lists_robots(site: Site) -> None:
    """One for each domain, or for each namespace that ends in a number; a machine without nodes says so and fails."""
    from tests.support.programs import ended

    code, out, _ = await ended("rmw-zenoh", "--all", "--dry-run", "-e", site.endpoint)
    assert (code, out) == (1, "no robots: there are no ROS nodes on the router\n")
    await site.robot.ask("publish", topic="/chatter", text="a", namespace="/robot4")
    code, out, _ = await ended("rmw-zenoh", "--all", "--dry-run", "-e", site.endpoint)
    assert (code, out) == (0, f"robot 4: domain {DOMAIN}, namespace /robot4\n")
