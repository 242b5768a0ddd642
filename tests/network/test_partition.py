"""Two sites lose the link between them, in silence, and get it back."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass

import pytest

from tests.network.hosts import Link, Network
from tests.network.inside import Inside
from tests.support.programs import Program
from tests.support.routers import Router

MERGED_S = 3.0
"""So soon after the link is back everybody sees who is there, and no two have one id: a limit the project promises."""
LEASE_MS = 2000
"""Of the routers: so long after the link fell silent each site takes the other for gone."""
ROUTER = [
    f"transport/link/tx/lease:{LEASE_MS}",
    # the pauses of TCP between attempts to connect double; above two seconds a new connection is quicker
    "transport/unicast/open_timeout:2000",
    "connect/retry:{period_init_ms:50,period_max_ms:200,period_increase_factor:2}",
]


@dataclass
class Site:
    """A router, a robot, a gateway and a headset."""

    robot: Inside
    headset: Inside
    robot_id: int

    async def online(self) -> set[tuple[str, int]]:
        """Who is online, as the headset is told."""
        return {(kind, number) for kind, number in await self.headset.ask("online")}

    async def works(self) -> None:
        """A command of the headset reaches the robot, and the robot's topic the headset."""
        await self.robot.received("/cmd_vel")
        await self.headset.received("/pose")
        await self.robot.until_received("/cmd_vel", 10)
        await self.headset.until_received("/pose", 10)


@dataclass
class Sites:
    """Two of them."""

    left: Site
    right: Site
    link: Link

    async def until_together(self, within_s: float) -> float:
        """Wait until both headsets see both robots and both headsets, each with an id of its own; how long it took."""
        began = time.monotonic()
        while True:
            ids = [await site.headset.ask("own_id") for site in (self.left, self.right)]
            everybody = {("ros", 7), ("ros", 8), *(("unity", number) for number in ids)}
            seen = [await site.online() for site in (self.left, self.right)]
            took_s = time.monotonic() - began
            if len(everybody) == 4 and seen == [everybody, everybody]:
                return took_s
            assert took_s < within_s, f"not together: headsets {ids}, online {seen}"
            await asyncio.sleep(0.02)

    async def until_apart(self) -> None:
        """Wait until neither headset sees anybody of the other site."""
        for site, other in ((self.left, self.right), (self.right, self.left)):
            await site.headset.until_gone("ros", other.robot_id)


@pytest.fixture
async def sites(network: Network, request: pytest.FixtureRequest) -> AsyncIterator[Sites]:
    """The parameter says whether the link is there when the gateways start."""
    left, right = network.host("left"), network.host("right")
    link = network.link(left, right, delay_ms=5)
    if not request.param:
        link.down()
    async with AsyncExitStack() as stack:
        made = []
        for host, robot_id, connect in (
            (left, 7, []),
            (right, 8, [f"tcp/{left.address_towards(right)}:7447"]),
        ):
            await stack.enter_async_context(
                Router(listen=["tcp/0.0.0.0:7447"], connect=connect, overrides=ROUTER, within=host.within)
            )
            local = "tcp/127.0.0.1:7447"
            robot = Inside("robot", id=robot_id, connect=[local], within=host.within)
            await stack.enter_async_context(robot)
            await stack.enter_async_context(Program("gateway", "-e", local, within=host.within))
            headset = await stack.enter_async_context(Inside("headset", port=7000, within=host.within))
            await headset.until_online("ros", robot_id)
            await headset.ask("subscribe", topic="/pose", robot=robot_id)
            await headset.ask("command", topic="/cmd_vel", robot=robot_id, hz=20)
            await robot.ask("stream", topic="/pose", hz=20, size=200)
            made.append(Site(robot, headset, robot_id))
        yield Sites(made[0], made[1], link)


@pytest.mark.parametrize("sites", [True], indirect=True)
async def test_sites_that_part_work_and_find_together(sites: Sites) -> None:
    """Parted in silence, each site works within itself and sees the other leave; 3 s after the link is back everybody
    sees everybody, and a headset hears the other site's robot again without registering again."""
    await sites.until_together(10)
    left, right = sites.left, sites.right
    await left.headset.ask("subscribe", topic="/far", robot=right.robot_id)
    await right.robot.ask("stream", topic="/far", hz=20, size=200)
    await left.headset.until_received("/far")
    sites.link.down()
    await left.works()
    await right.works()
    await sites.until_apart()
    await left.works()
    await right.works()
    sites.link.up()
    print(f"together after {await sites.until_together(MERGED_S):.2f} s")
    await left.headset.received("/far")
    await left.headset.until_received("/far")
    await left.works()
    await right.works()


@pytest.mark.parametrize("sites", [False], indirect=True)
async def test_sites_that_started_apart_share_no_id(sites: Sites) -> None:
    """Two sites that never saw each other give out the same ids; 3 s after they meet every headset has an id of its
    own, and commands and topics go on under it."""
    assert [await site.headset.ask("own_id") for site in (sites.left, sites.right)] == [1, 1]
    await sites.left.works()
    await sites.right.works()
    sites.link.up()
    print(f"together after {await sites.until_together(MERGED_S):.2f} s")
    await sites.left.works()
    await sites.right.works()
