"""What ends without a word while a browser drives: the browser itself, its gateway, the router; killed, or stopped
and going on later. The robot has stopped in the time of its dead-man, and nothing held meanwhile drives on."""

from __future__ import annotations

import asyncio
import math
import os
import signal
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import HELD, ROBOT, Act, Site
from tests.page.driving import Heard, drives, heard_at, within
from tests.page.headsets import UNDRAWN, by_grip, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import OFFLINE, Watched, another, needs_browser

if TYPE_CHECKING:
    from playwright.async_api import Browser, Playwright

pytestmark = [needs_browser, pytest.mark.timeout(240)]
AGE_S = 1.0
RULES = f"[robot]\nmax_timed_command_age_s = {AGE_S}\n{ROBOT}"
"""On a busy machine commands get older than they are by default. The dead-man is that of each site."""
ENDED_MS = 500.0 + 100.0
"""The time of the dead-man, and a tenth of a second."""
STOPPED_S = AGE_S + 1.0
"""What was on its way when something stood still is too old when that goes on."""


@dataclass
class Place:
    """Where somebody drives."""

    watched: Watched
    drives: Callable[[Heard], Awaitable[object]]
    """Take hold until the robot is told to go."""
    ready: Act
    """Wait until it may be driven."""
    let_go: Act
    held: Callable[[], Awaitable[Any]]


async def at_the_pad(site: Site) -> Place:
    page = await site.with_robot()

    ready = partial(page.page.wait_for_selector, '#pad[aria-disabled="false"]', timeout=60_000)
    return Place(page, partial(drives, page), ready, page.page.mouse.up, partial(page.value, HELD))


async def in_the_scene(site: Site) -> Place:
    headset = await headset_at(site, settings={"cameras": []}, size=UNDRAWN)
    await headset.ready(pictures=False)
    await headset.enter()
    take, let_go = by_grip(headset)

    async def drives(heard: Heard) -> None:
        await headset.drives(heard, take, let_go)

    ready = partial(until, lambda: headset.state("barred === ''"))
    return Place(headset.watched, drives, ready, let_go, partial(headset.state, "held"))


PLACES = [
    pytest.param(at_the_pad, id="pad"),
    pytest.param(in_the_scene, id="xr", marks=needs_headset),
]
Open = Callable[[Site], Awaitable[Place]]


async def stopped_after(heard: Heard, end: Act) -> float:
    """How many ms after something began to end the robot is told to stand; inf where it was before, as when a busy
    machine lets a page stand still."""
    began = time.monotonic()
    if not heard.last:
        return math.inf
    await end()
    await until(lambda: heard.last == 0.0)
    return (heard.stopped_at - began) * 1000 if heard.stopped_at > began else math.inf


async def processes(own: Browser) -> list[int]:
    """All of a browser, its first one first."""
    session = await own.new_browser_cdp_session()
    found = (await session.send("SystemInfo.getProcessInfo"))["processInfo"]
    return [each["id"] for each in sorted(found, key=lambda each: each["type"] != "browser")]


def tell(which: list[int], what: signal.Signals) -> None:
    for each in which:
        with suppress(ProcessLookupError):
            os.kill(each, what)


@pytest.mark.parametrize("place", PLACES)
async def test_a_browser_that_is_killed_stops_its_robot(site: Site, driver: Playwright, place: Open) -> None:
    """By SIGKILL, while it drives: nothing is said any more, and the robot stands in time."""
    async with heard_at(site) as heard:

        async def measured() -> float:
            async with another(driver) as own:
                at = await place(replace(site, chromium=always(own), pages=[]))
                (first, *_) = await processes(own)
                await at.drives(heard)
                at.watched.judge()

                async def end() -> None:
                    os.kill(first, signal.SIGKILL)

                took_ms = await stopped_after(heard, end)
                after = len(heard.speeds)
                await asyncio.sleep(0.3)
                assert set(heard.speeds[after:]) <= {0.0}
                return took_ms

        print("killed", await within(ENDED_MS, measured))


@pytest.mark.parametrize("place", PLACES)
async def test_a_browser_that_stands_still_stops_its_robot(site: Site, driver: Playwright, place: Open) -> None:
    """By SIGSTOP to all its processes: the robot stands in time, and when they go on, with the hold still held, what
    was on its way and what is held drive nothing."""
    async with heard_at(site) as heard, another(driver) as own:
        at = await place(replace(site, chromium=always(own), pages=[]))
        every = await processes(own)

        async def end() -> None:
            tell(every, signal.SIGSTOP)

        async def measured() -> float:
            await at.drives(heard)
            try:
                took_ms = await stopped_after(heard, end)
                after = len(heard.speeds)
                await asyncio.sleep(STOPPED_S)
            finally:
                tell(every, signal.SIGCONT)
            await drives_nothing(at, heard, after)
            return took_ms

        print("stopped", await within(ENDED_MS, measured))
        at.watched.judge()


WAYS = {"killed": signal.SIGKILL, "stopped": signal.SIGSTOP}


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("place", PLACES)
async def test_a_gateway_or_router_that_ends_stops_the_robot(site: Site, place: Open, how: str) -> None:
    """Each by itself: the robot stands in time, and when it is back, nothing drives: neither what is held still
    nor what was on its way. Of a router that stands still nobody tells a page, so there somebody lets go meanwhile."""
    async with heard_at(site) as heard:
        at = await place(site)
        at.watched.allowed.append(OFFLINE)
        for program in (site.gateway, site.router):

            async def end(program: Any = program) -> None:
                program.send_signal(WAYS[how])

            async def measured(program: Any = program, end: Act = end) -> float:
                await at.drives(heard)
                try:
                    took_ms = await stopped_after(heard, end)
                    after = len(heard.speeds)
                    if program is site.router and how == "stopped":
                        await at.let_go()
                    await asyncio.sleep(STOPPED_S)
                finally:
                    if how == "killed":
                        await program.stop()
                        await program.start()
                    else:
                        program.send_signal(signal.SIGCONT)
                await drives_nothing(at, heard, after)
                return took_ms

            print(how, program.argv[0], await within(ENDED_MS, measured))


async def drives_nothing(at: Place, heard: Heard, after: int) -> None:
    """It may be driven again, what is held still drives nothing, and it is let go of in the end."""
    await until(lambda: lost(at))
    await at.ready()
    await asyncio.sleep(0.5)
    assert set(heard.speeds[after:]) <= {0.0}
    await at.let_go()


async def lost(at: Place) -> bool:
    return not await at.held()


def always(own: Browser) -> Callable[[], Awaitable[Browser]]:
    async def get() -> Browser:
        return own

    return get
