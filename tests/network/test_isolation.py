"""Two sites: what a consumer at one that is slow, or has stopped, costs the commands at the other."""

from __future__ import annotations

import asyncio
import signal
import statistics
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass

import pytest

from tests.network.inside import Inside, Received, lost, median_ms
from tests.support.programs import Program, free_port
from tests.support.routers import Router

RAISED = 1.2
"""Commands may take so much longer: a limit that the project promises."""
HZ = 100
"""Of the commands."""
ROUNDS = 3
ROUND_S = 2.5
"""Each round is so long without the disturbance and then with it: longer than the lease of who stopped, 2 s."""
MOST_LOST = 0.01
"""Of the commands sent during the disturbance."""
TRIES = 4
"""What else runs on the machine disturbs as well; a ratio above the limit is measured again."""
NEAR = ["transport/link/tx/queue/congestion_control/block/wait_before_close:500000"]
"""Not longer than that of agents and gateways, so that it is the stuck link that is closed, and not one behind it."""
SMALL_BUFFERS = ["transport/link/tcp:{so_sndbuf:65536,so_rcvbuf:65536}"]
"""At the site with the bad consumer: megabytes in the kernel would hide for seconds that nobody takes anything."""
FAR = [*NEAR, *SMALL_BUFFERS]


@dataclass
class Sites:
    """At one site robot 7 with a gateway and a headset that commands it; at the other a gateway and a headset that
    takes the robot's topic, and messages of the kept kind."""

    robot: Inside
    near: Inside
    far: Inside
    far_gateway: Program

    @asynccontextmanager
    async def stopped(self) -> AsyncIterator[None]:
        """The far gateway takes nothing."""
        self.far_gateway.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self.far_gateway.send_signal(signal.SIGCONT)

    @asynccontextmanager
    async def slow(self) -> AsyncIterator[None]:
        """The far gateway runs a tenth of the time."""

        async def limp() -> None:
            while True:
                self.far_gateway.send_signal(signal.SIGSTOP)
                await asyncio.sleep(0.18)
                self.far_gateway.send_signal(signal.SIGCONT)
                await asyncio.sleep(0.02)

        limping = asyncio.create_task(limp())
        try:
            yield
        finally:
            limping.cancel()
            with suppress(asyncio.CancelledError):
                await limping
            self.far_gateway.send_signal(signal.SIGCONT)


@pytest.fixture
async def sites() -> AsyncIterator[Sites]:
    here, there = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(Router(listen=[here], overrides=NEAR))
        await stack.enter_async_context(Router(listen=[there], connect=[here], overrides=FAR))
        robot = await stack.enter_async_context(Inside("robot", id=7, connect=[here]))
        gateways = [
            await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint, *options))
            for endpoint, options in ((here, []), (there, [w for value in SMALL_BUFFERS for w in ("--cfg", value)]))
        ]
        near, far = [await stack.enter_async_context(Inside("headset", port=gateway.port)) for gateway in gateways]
        for headset in (near, far):
            await headset.until_online("ros", 7)
            await headset.ask("subscribe", topic="/scan", robot=7)
        await robot.until_online("unity", await far.ask("own_id"))
        await near.ask("command", topic="/cmd_vel", robot=7, hz=HZ)
        await robot.ask("stream", topic="/scan", hz=100, size=20_000)
        await robot.ask("send_on", headset=await far.ask("own_id"), hz=50, size=1000)
        yield Sites(robot, near, far, gateways[1])


@pytest.mark.parametrize("how", ["stopped", "slow"])
async def test_a_bad_consumer_at_one_site_costs_commands_at_the_other_nothing(how: str, sites: Sites) -> None:
    """While a gateway at one site is stopped, or far too slow for what it is sent, commands within the other site take
    at most 20 % longer, by the median of rounds with and without it in turn, and at most 1 % of them is lost."""
    for _ in range(TRIES):
        calm, disturbed, missing = [], [], 0
        for _ in range(ROUNDS):
            calm.append(median_ms(await _commands(sites)))
            async with sites.stopped() if how == "stopped" else sites.slow():
                commands = await _commands(sites)
            disturbed.append(median_ms(commands))
            missing += lost(commands, commands[0].number, commands[-1].number + 1)
            await sites.far.received("/scan")
            await sites.far.until_received("/scan", 20)
        ratio = statistics.median(disturbed) / statistics.median(calm)
        share = missing / (ROUNDS * ROUND_S * HZ)
        print(f"{how}: {ratio:.2f} times as long, {share:.1%} lost; calm {calm} ms, disturbed {disturbed} ms")
        if ratio <= RAISED and share <= MOST_LOST:
            break
    assert ratio <= RAISED
    assert share <= MOST_LOST


async def _commands(sites: Sites) -> list[Received]:
    """The commands that arrive in one round."""
    await sites.robot.received("/cmd_vel")
    await asyncio.sleep(ROUND_S)
    return await sites.robot.received("/cmd_vel")
