"""A headset that loses its connection and may come back, with real processes: the robot stops, and keeps its place."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message

import macs_zenoh
from bridge.headset.client import Headset
from bridge.headset.nodes import Publisher
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.messages import UNITY
from tests.ros.driven import STOPPED, Heard, hear
from tests.support.networks import Network, network
from tests.support.programs import Program, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import until

SETTINGS = """
[[robot.rules]]
match = "/arm"
exclusive = true
hold_s = {hold_s}
deadman_message = {{ linear = {{ z = -1 }} }}
"""


@dataclass
class Site:
    """A headset that drives, another that would like to, and who sees them; what the robot's topic carries."""

    driver: Headset
    net: Network
    commands: Publisher
    other: Headset
    others: Publisher
    observer: Agent
    heard: Heard

    @property
    def is_asleep(self) -> bool:
        """Whether the driver is, as others see it."""
        seen = self.observer.directory.get(UNITY, self.driver.id)
        assert seen is not None, "it has left"
        return seen.asleep > 0


@pytest.fixture
async def site(request: Any, domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Site]:
    """Nothing but the driver's leaving trips the dead-man; the parameter is how long control is held."""
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS.format(hold_s=request.param))
    heard = await hear(peer, "/arm")
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        common = ("-e", endpoint, "--settings", str(settings))
        await stack.enter_async_context(Program("router", "-l", endpoint))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", *common))
        robot = Program("agent", "--id", "1", *common, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        observer = await stack.enter_async_context(macs_zenoh.join("unity", id=60_000, connect=[endpoint]))
        net = await stack.enter_async_context(network(gateway.port))
        driver = await stack.enter_async_context(await Headset.connect("127.0.0.1", net.port, reconnect=True))
        other = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        await until(lambda: (1, 1) in observer.directory and (UNITY, driver.id) in observer.directory)
        commands, others = [
            await each.advertise("/arm", "geometry_msgs/Twist", agents=[1]) for each in (driver, other)
        ]
        yield Site(driver, net, commands, other, others, observer, heard)


def twist(x: float) -> bytes:
    """A command."""
    message = Twist()
    message.linear.x = x
    return bytes(serialize_message(message))


async def drive(site: Site, commands: Publisher, x: float) -> None:
    """Until it is heard."""
    deadline = asyncio.get_running_loop().time() + 60
    while site.heard.last != x:
        await commands.publish(twist(x))
        await asyncio.sleep(0.02)
        assert asyncio.get_running_loop().time() < deadline


@pytest.mark.parametrize("site", [60], indirect=True)
@pytest.mark.parametrize("how", ["rst", "fin"])
async def test_a_headset_that_may_come_back_stops_the_robot(site: Site, how: Any) -> None:
    """As soon as its connection ends, while others still see it; back again it moves the robot by a new command only,
    without registering anew, and has kept control."""
    await drive(site, site.commands, 0.5)
    site.net.is_cut = True
    site.net.lose(how)
    await until(lambda: site.heard.last == STOPPED)
    await until(lambda: site.is_asleep)
    await site.others.publish(twist(0.25))
    await until(lambda: site.others.refusing())
    site.net.is_cut = False
    await until(lambda: site.driver.connected)
    await until(lambda: not site.is_asleep)
    assert site.heard.last == STOPPED
    assert 0.25 not in [value for _, value in site.heard.values]
    await drive(site, site.commands, 0.75)


@pytest.mark.parametrize("site", [60], indirect=True)
async def test_another_socket_is_another_connection(site: Site) -> None:
    """Also where the old one still seems to live: the robot stops, and goes on by a new command."""
    await drive(site, site.commands, 0.5)
    site.net.lose("silence")
    site.driver.drop_connection()
    await until(lambda: site.heard.last == STOPPED)
    await until(lambda: site.driver.connected)
    await drive(site, site.commands, 0.75)


@pytest.mark.parametrize("site", [1.0], indirect=True)
async def test_control_is_kept_no_longer_than_its_hold(site: Site) -> None:
    """When that is over another has it, and who comes back does not."""
    await drive(site, site.commands, 0.5)
    site.net.is_cut = True
    site.net.lose("rst")
    await until(lambda: site.heard.last == STOPPED)
    await drive(site, site.others, 0.25)
    assert site.is_asleep
    site.net.is_cut = False
    await until(lambda: site.driver.connected)
    driving = asyncio.create_task(keep_driving(site.others))

    async def refused() -> bool:
        """Said again: what is sent as it comes back may be too old."""
        await site.commands.publish(twist(0.75))
        return bool(site.commands.refusing())

    await until(refused, every_s=0.05)
    driving.cancel()
    assert 0.75 not in [value for _, value in site.heard.values]


async def keep_driving(commands: Publisher) -> None:
    """So that its hold goes on."""
    while True:
        await commands.publish(twist(0.25))
        await asyncio.sleep(0.05)
