"""The dead-man with real processes: a headset drives a robot, and its gateway dies."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message

from bridge.headset.client import Headset
from bridge.headset.nodes import Publisher
from tests.support.delays import Delays
from tests.support.programs import Program, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get

SILENCE_S = 0.5
LEASE_S = 1.0
MARGIN_S = 0.1

SETTINGS = f"""
[mesh]
lease_ms = {LEASE_S * 1000:.0f}

[[robot.rules]]
match = "/cmd_vel"
deadman_s = {SILENCE_S}
deadman_message = {{ linear = {{ z = -1 }} }}

[[robot.rules]]
match = "/arm"
deadman_message = {{ linear = {{ z = -1 }} }}
"""


@dataclass
class Driving:
    """A headset that drives a robot through a gateway, and what arrives on the robot's topic, with its time."""

    router: Program
    gateway: Program
    heard: asyncio.Queue[tuple[float, Any]]
    delays: Delays


@pytest.fixture
async def driving(request: Any, domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Driving]:
    """Commands at 20 Hz on the topic that the test names."""
    topic = request.param
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS)
    heard: asyncio.Queue[tuple[float, Any]] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def take(message: Any) -> None:
        loop.call_soon_threadsafe(heard.put_nowait, (time.monotonic(), message))

    await peer.session.run(lambda: peer.session.node.create_subscription(Twist, topic, take, 10))
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        common = ("--settings", str(settings))
        router = Program("router", "-l", endpoint, *common)
        await router.start()
        stack.push_async_callback(router.stop, signal.SIGKILL)
        gateway = Program("gateway", "--port", "0", "-e", endpoint, *common)
        await gateway.start()
        stack.push_async_callback(gateway.stop, signal.SIGKILL)
        robot = Program("agent", "--id", "1", "-e", endpoint, *common, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        while (await headset.online()).ros_agent_ids != [1]:
            await asyncio.sleep(0.02)
        commands = await headset.advertise(topic, "geometry_msgs/Twist", agents=[1])
        task = asyncio.create_task(_drive(commands))
        for _ in range(20):
            await get(heard)
        with Delays() as delays:
            yield Driving(router, gateway, heard, delays)
        task.cancel()


async def _drive(commands: Publisher) -> None:
    twist = Twist()
    twist.linear.x = 0.5
    cdr = bytes(serialize_message(twist))
    while True:
        await commands.publish(cdr)
        await asyncio.sleep(0.05)


async def _stop_message(driving: Driving, since: float) -> tuple[float, float]:
    """When the stop message arrived, and how much later than on an idle machine that may have been. One from before,
    of a machine that stood still while somebody drove, counts if nothing was carried out behind it: then there is none
    to come."""
    before: float | None = None
    while True:
        try:
            at, twist = await get(driving.heard, PATIENCE_S if before is None else 5 * LEASE_S)
        except asyncio.TimeoutError:
            if before is None:
                raise
            return before, driving.delays.s()
        before = at if twist.linear.z == -1 else None
        if before is not None and at > since:
            return at, driving.delays.s()


@pytest.mark.parametrize("driving", ["/cmd_vel", "/arm"], indirect=True)
async def test_a_killed_gateway_stops_the_robot(driving: Driving) -> None:
    """After kill -9 of the headset's gateway the stop message is there within the configured time and 100 ms."""
    driving.delays.s()
    killed = time.monotonic()
    driving.gateway.send_signal(signal.SIGKILL)
    at, delay_s = await _stop_message(driving, killed)
    assert at - killed < SILENCE_S + MARGIN_S + delay_s
    await asyncio.sleep(SILENCE_S)
    after = [True]
    while not driving.heard.empty():
        after.append(driving.heard.get_nowait()[1].linear.z == -1)
    assert not any(stop and again for stop, again in pairwise(after)), "it is published once"


@pytest.mark.parametrize("driving", ["/arm"], indirect=True)
async def test_a_stopped_gateway_stops_the_robot(driving: Driving) -> None:
    """After SIGSTOP of the gateway, which closes nothing, the message is there within a lease and 100 ms."""
    driving.delays.s()
    stopped = time.monotonic()
    driving.gateway.send_signal(signal.SIGSTOP)
    at, delay_s = await _stop_message(driving, stopped)
    assert at - stopped < LEASE_S + MARGIN_S + delay_s


@pytest.mark.parametrize("driving", ["/arm"], indirect=True)
async def test_a_lost_router_stops_the_robot(driving: Driving) -> None:
    """A robot that is cut off from the mesh stops after a lease, although it sees nobody leave."""
    driving.delays.s()
    killed = time.monotonic()
    driving.router.send_signal(signal.SIGKILL)
    at, delay_s = await _stop_message(driving, killed)
    assert at - killed < LEASE_S + 2 * MARGIN_S + delay_s
