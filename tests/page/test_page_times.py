"""How soon the page does what it promises, case by case. Each may be late a few times, as on a busy machine, and not
always."""

from __future__ import annotations

import asyncio
import contextlib
import math
import signal
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import HELD, Site, says
from tests.page.driving import drives, heard_at, within
from tests.page.polls import until
from tests.support.browser import OFFLINE, Watched, needs_browser
from tests.support.links import Link, counted

pytestmark = [needs_browser, pytest.mark.timeout(240)]

ZERO_MS = 100.0
DEADMAN_MS = 500.0 + ZERO_MS
"""As the site's rule has it."""
BACK_MS = 2000.0
LOST_MS = 3000.0
CAMERA = "#camera--camera-image-compressed"
SHOWN = f"document.querySelector('{CAMERA} canvas').dataset.shown"
FRESH = 4
"""Commands of a fifth of a second: so many may be on their way when a network stands still."""

HIDDEN = "Object.defineProperty(document, 'hidden', {value: true});"
LETTING_GO: dict[str, tuple[str, float]] = {
    "released": ("", ZERO_MS),
    "window blurred": ("window.dispatchEvent(new Event('blur'))", ZERO_MS),
    "tab hidden": (f"{HIDDEN} document.dispatchEvent(new Event('visibilitychange'))", ZERO_MS),
    "page closed": ("close", DEADMAN_MS),
    "connection cut": ("macsPage.headset.abort()", DEADMAN_MS),
}


@pytest.mark.parametrize("how", LETTING_GO)
async def test_a_zero_follows_at_once(site: Site, how: str) -> None:
    """However it is let go, by the clock of the robot's host: nothing else follows the zero."""
    script, limit_ms = LETTING_GO[how]
    async with heard_at(site) as heard:

        async def measured() -> float:
            page = await site.with_robot()
            await drives(page, heard)
            began = time.monotonic()
            if not script:
                await page.page.mouse.up()
            elif script == "close":
                await page.page.close(run_before_unload=False)
            else:
                await page.value(script)
            await until(lambda: heard.last == 0.0)
            took_ms = (heard.stopped_at - began) * 1000
            after = len(heard.speeds)
            await asyncio.sleep(0.3)
            assert set(heard.speeds[after:]) <= {0.0}
            await page.page.context.close()
            return took_ms

        print(how, await within(limit_ms, measured))


@contextlib.asynccontextmanager
async def behind_a_link(site: Site) -> AsyncIterator[tuple[Watched, Link]]:
    """A page whose way to the gateway can stand still."""
    async with counted(f"tcp/127.0.0.1:{site.web_port}") as link:
        port = link.endpoint.rpartition(":")[2]
        page = await site.open()
        await page.page.goto(f"http://127.0.0.1:{port}/")
        await page.page.wait_for_selector("#trail canvas[data-x]", timeout=60_000)
        await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
        yield page, link


async def test_a_network_that_stands_still_ends_a_drive(site: Site) -> None:
    """Nothing gets through to the gateway: the dead-man acts; what was on its way is old when it comes, and of it the
    robot is told no more than was fresh when it stood still. The page says why it has let go."""
    async with heard_at(site) as heard, behind_a_link(site) as (page, link):

        async def measured() -> float:
            await drives(page, heard)
            link.hold()
            began = time.monotonic()
            await until(lambda: heard.last == 0.0)
            took_ms = (heard.stopped_at - began) * 1000
            await until(partial(page.value, f"!{HELD}"))
            if not await says(page, "#drive-hint", "not fresh"):
                took_ms = math.inf  # the page stood still, and had let go for that
            await asyncio.sleep(0.5)
            stopped = len(heard.speeds)
            link.release()
            await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
            await until(lambda: heard.last == 0.0)
            await asyncio.sleep(0.5)
            late = sum(speed > 0 for speed in heard.speeds[stopped:])
            print(f"zero after {took_ms:.0f} ms; {late} commands came late")
            assert late <= FRESH
            await page.page.mouse.up()
            return took_ms

        await within(DEADMAN_MS + 200.0, measured)  # the last one may have left just before the network stood still


async def test_it_is_back_soon_after_its_gateway(site: Site) -> None:
    """Killed and started again, without a reload, from the moment at which the gateway says that it is ready."""
    page = await site.with_robot()
    page.allowed.append(OFFLINE)
    await page.value("window.same = 'page'; undefined")

    async def measured() -> float:
        await site.gateway.stop(signal.SIGKILL)
        await page.page.wait_for_selector('#link[data-state="lost"]')
        await site.gateway.start()
        return await since(partial(page.value, "macsPage.headset.connected"))

    print("gateway", await within(BACK_MS, measured))
    assert await page.value("window.same") == "page"


async def test_it_is_back_soon_after_its_router(site: Site) -> None:
    """Killed and started again: the robot's pictures come again, from the moment at which the router is ready."""
    page = await site.with_robot()

    async def more(before: int) -> bool:
        return int(await page.value(SHOWN)) > before

    async def measured() -> float:
        await site.router.stop(signal.SIGKILL)
        await page.page.wait_for_selector(f"{CAMERA} .overlay", timeout=60_000)
        await site.router.start()
        return await since(partial(more, int(await page.value(SHOWN))))

    print("router", await within(BACK_MS, measured))


async def test_a_lost_robot_is_shown_soon(site: Site) -> None:
    """Its agent is killed: from that moment until the page says so."""
    page = await site.with_robot()
    state = "document.querySelector('[data-robot=\"1\"]').dataset.state"

    async def measured() -> float:
        site.agent.send_signal(signal.SIGKILL)
        took_ms = await since(partial(page.value, f"{state} === 'lost'"))
        await site.agent.stop()
        await site.agent.start()
        await until(partial(page.value, f"{state} === 'online'"))
        return took_ms

    print("robot", await within(LOST_MS, measured))


async def since(true: Callable[[], Awaitable[object]], began: float | None = None) -> float:
    """How many ms it takes until something is so."""
    began = time.monotonic() if began is None else began
    while not await true():
        await asyncio.sleep(0.01)
    return (time.monotonic() - began) * 1000
