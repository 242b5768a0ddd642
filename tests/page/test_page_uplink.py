"""Pages cost a robot's link what one of them does, however many there are: bytes on the link, with real browsers."""

from __future__ import annotations

import asyncio

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import StartSite
from tests.page.polls import until
from tests.support.browser import Watched, needs_browser
from tests.support.links import Link, counted
from tests.support.programs import Program

pytestmark = [needs_browser, pytest.mark.timeout(280)]

PAGES = 10
MEASURED_S = 5.0
MORE = 1.1
"""So many times the bytes may ten pages take: beats and answers fall into one time of measuring or the other."""
SHOWN = "document.querySelector('#camera--camera-image-compressed canvas').dataset.shown"


async def per_second(link: Link) -> float:
    """Bytes a second towards the router."""
    loop = asyncio.get_running_loop()
    before, began = link.up_bytes, loop.time()
    await asyncio.sleep(MEASURED_S)
    return (link.up_bytes - before) / (loop.time() - began)


async def all_show(pages: list[Watched]) -> None:
    """Wait until each has more pictures than before."""
    for page in pages:
        before = int(await page.value(SHOWN))

        async def more(page: Watched = page, before: int = before) -> bool:
            return int(await page.value(SHOWN)) > before

        await until(more)


async def test_ten_pages_cost_a_robot_what_one_does(start_site: StartSite) -> None:
    """Its pictures, place, map, plots and state for ten pages, and the mesh for ten: no more bytes than for one."""
    site = await start_site()
    environment = {"ROS_DOMAIN_ID": str(site.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    await site.agent.stop()
    async with (
        counted(site.endpoint) as link,
        Program("agent", "--id", "1", "-e", link.endpoint, env=environment),
    ):
        pages = [await site.with_robot(viewport={"width": 800, "height": 600})]
        await all_show(pages)
        one = await per_second(link)
        await pages[0].value("location.hash = 'mesh'")
        await pages[0].page.wait_for_selector("#mesh svg.mesh g.robot")
        one_mesh = await per_second(link)
        await pages[0].value("location.hash = 'robot'")
        while len(pages) < PAGES:
            pages.append(await site.with_robot(viewport={"width": 800, "height": 600}))
        await all_show(pages)
        ten = await per_second(link)
        await all_show(pages)
        for page in pages:
            await page.value("location.hash = 'mesh'")
            await page.page.wait_for_selector("#mesh svg.mesh g.robot")
        ten_mesh = await per_second(link)
    print(
        f"bytes a second: one page {one:.0f}, ten {ten:.0f}; in the mesh view one {one_mesh:.0f}, ten {ten_mesh:.0f}"
    )
    assert one > 20_000  # the pictures do come this way
    assert ten <= MORE * one
    assert ten_mesh <= MORE * one_mesh
