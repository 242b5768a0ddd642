"""Two routers, and one of them is killed: how much of a fast stream is lost, and for how long it stands still."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass

import pytest

from tests.network.inside import Inside, Received, longest_gap_s, lost
from tests.support.programs import Program, free_port
from tests.support.routers import Router

HZ = 200
WINDOW_S = 10.0
"""The share of lost messages is that of so long a time with one kill in it."""
MOST_LOST = 0.01
FAILOVER_S = 0.25
"""These two are limits that the project promises."""
TRIES = 3
"""A machine that stops this test for 50 ms costs as much as a failure; so it may be tried again, and says so."""


@dataclass
class Site:
    """Robot 7 is on the first router, the gateway on the second; each knows the other router as well."""

    routers: list[Router]
    robot: Inside
    headset: Inside
    received: list[Received]

    async def stream_for(self, seconds: float) -> None:
        """Let the stream run and take what has arrived."""
        await asyncio.sleep(seconds)
        self.received += await self.headset.received("/count")

    async def sent(self) -> int:
        """How many messages the robot has sent."""
        sent: int = (await self.robot.ask("sent", topic="/count"))["sent"]
        return sent


@pytest.fixture
async def site() -> AsyncIterator[Site]:
    endpoints = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
    retry = "connect/retry:{period_init_ms:50,period_max_ms:200,period_increase_factor:2}"
    async with AsyncExitStack() as stack:
        routers = [
            await stack.enter_async_context(Router(listen=[own], connect=[other], overrides=[retry]))
            for own, other in (endpoints, endpoints[::-1])
        ]
        robot = await stack.enter_async_context(Inside("robot", id=7, connect=endpoints))
        known = [word for endpoint in endpoints[::-1] for word in ("-e", endpoint)]
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", *known))
        headset = await stack.enter_async_context(Inside("headset", port=gateway.port))
        await headset.until_online("ros", 7)
        await headset.ask("subscribe", topic="/count", robot=7)
        await robot.until_registered("/count")
        await robot.ask("stream", topic="/count", hz=HZ, size=200)
        yield Site(routers, robot, headset, [])


@pytest.mark.parametrize("number", [0, 1], ids=["robots-router", "gateways-router"])
async def test_a_killed_router_costs_little_of_a_fast_stream(number: int, site: Site) -> None:
    """Kill -9 of the robot's router or of the gateway's loses at most 1 % of a 200 Hz stream over 10 s and stops it
    for less than 250 ms; with both routers back, everything is as before."""
    tries = []
    for attempt in range(TRIES):
        # after the first, both are on the router that was left, so that is the one to kill next
        tries.append(await _kill_once(site, (number + attempt) % 2))
        share, gap_s = tries[-1]
        if share <= MOST_LOST and gap_s < FAILOVER_S:
            break
    print("lost, longest gap:", *(f"{share:.2%}, {gap_s * 1000:.0f} ms" for share, gap_s in tries))
    assert share <= MOST_LOST
    assert gap_s < FAILOVER_S
    numbers = [message.number for message in site.received]
    assert numbers == sorted(set(numbers)), "something came twice or out of order"
    assert ["ros", 7] in await site.headset.ask("online")


async def _kill_once(site: Site, number: int) -> tuple[float, float]:
    """Kill a router in the middle of a window and start it again after it; the share lost and the longest gap."""
    site.received.clear()
    await site.stream_for(1.0)  # what went before is not counted
    first = await site.sent()
    await site.stream_for(WINDOW_S / 2)
    await site.routers[number].stop(signal.SIGKILL)
    await site.stream_for(WINDOW_S / 2)
    after = await site.sent()
    await site.stream_for(0.5)
    window = [message for message in site.received if first <= message.number < after]
    await site.routers[number].start()
    await site.stream_for(1.0)
    return lost(window, first, after) / (after - first), longest_gap_s(window)
