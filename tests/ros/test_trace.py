"""Messages traced from a ROS node to sockets, and from sockets to ROS."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from bridge.headset.client import Headset
from tests.support.programs import Program, ended, free_port
from tests.support.ros_peer import Peer, say_hello
from tests.support.waiting import PATIENCE_S, get, until


@pytest.fixture
async def site(domain: int, peer: Peer) -> AsyncIterator[tuple[str, Headset]]:
    """A robot whose node says hello, and a headset."""
    talking = asyncio.create_task(say_hello(peer, await peer.publisher(String, "/chatter")))
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        robot = Program("agent", "--id", "7", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        yield endpoint, headset
    talking.cancel()


async def test_a_topic_is_traced_from_its_node_to_the_sockets(site: tuple[str, Headset]) -> None:
    """The node's own time comes first, the gateway's sockets last; as a table and for programs."""
    endpoint, headset = site
    subscription = await headset.subscribe("/chatter", "std_msgs/String", agents=[7])
    await asyncio.wait_for(anext(subscription), PATIENCE_S)
    code, out, log = await ended("trace", "/chatter", "--count", "5", "--seconds", "60", "--json", "-e", endpoint)
    assert code == 0, log
    ways = [json.loads(line) for line in out.splitlines()]
    (way,) = [way for way in ways if way["receiver"].startswith("gateway ")]
    hops = [hop["hop"] for hop in way["hops"]]
    assert hops[:3] == ["robot 7: ROS to its agent", "robot 7: agent", "robot 7: into Zenoh"]
    assert hops[3].startswith("robot 7 to router ")
    assert hops[-1].endswith(": handled")
    assert all(hop["p50_ms"] >= 0 for hop in way["hops"])
    (here,) = [way for way in ways if way["receiver"] == "here"]
    assert here["count"] >= 1
    code, out, _ = await ended("trace", "/chatter", "--count", "3", "--seconds", "60", "-e", endpoint)
    assert code == 0
    assert out.startswith("/chatter of robot 7 to ")
    assert "end to end" in out
    assert "clocks: " in out
    code, _, log = await ended("trace", "/chater", "--seconds", "1", "-e", endpoint)
    assert (code, "did you mean /chatter?" in log) == (1, True)


async def test_commands_are_traced_into_ros(site: tuple[str, Headset], peer: Peer) -> None:
    """From the headset's socket to the robot; where nobody commands, that is said."""
    endpoint, headset = site
    code, _, log = await ended("trace", "/cmd_vel", "--commands", "--seconds", "0.5", "-e", endpoint)
    assert (code, "nobody has sent a command" in log) == (1, True)
    driven = await peer.subscription(Twist, "/cmd_vel")
    publisher = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[7])

    async def drive() -> None:
        while True:
            await publisher.publish(bytes(serialize_message(Twist())), agents=[7])
            await asyncio.sleep(0.02)

    driving = asyncio.create_task(drive())
    try:
        await get(driven)
        code, out, log = await ended(
            "trace", "/cmd_vel", "--commands", "--count", "5", "--seconds", "60", "--json", "-e", endpoint
        )
    finally:
        driving.cancel()
    assert code == 0, log
    way = json.loads(out.splitlines()[0])
    hops = [hop["hop"] for hop in way["hops"]]
    assert hops[0].endswith(": gateway")
    assert hops[-1] == "robot 7: handled"
    await until(lambda: driving.done())
