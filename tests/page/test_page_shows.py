"""What else the page shows of a real robot, in a real browser: its map under its place, and the way of commands."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

import pytest

pytest.importorskip("rclpy")

from bridge.headset.client import Headset
from macs_zenoh.typed import Types
from tests.page.conftest import Site, says
from tests.page.polls import until
from tests.support.browser import Watched, needs_browser

pytestmark = needs_browser

SIZE = "document.querySelector('#trail canvas').dataset.map"
COLOURED = """(([selector, colour]) => {
  const canvas = document.querySelector(selector);
  const wanted = getComputedStyle(canvas).getPropertyValue(colour).trim().slice(1);
  const [red, green, blue] = [0, 2, 4].map((at) => parseInt(wanted.slice(at, at + 2), 16));
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let found = 0;
  for (let at = 0; at < data.length; at += 4) {
    if (data[at] === red && data[at + 1] === green && data[at + 2] === blue) found += 1;
  }
  return found;
})"""
"""How many pixels of a canvas have a colour of the page."""


async def coloured(page: Watched, selector: str, colour: str) -> int:
    """As the next frame shows it."""
    await page.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return int(await page.page.evaluate(COLOURED, [selector, colour]))


async def occupied(page: Watched) -> int:
    """Pixels of the place where something is."""
    return await coloured(page, "#trail canvas", "--map-occupied")


async def test_a_map_lies_under_the_place(site: Site) -> None:
    """It comes by itself, shows pillars where there are some, and goes and comes again as somebody chooses."""
    page = await site.with_robot()
    await until(partial(page.value, f"{SIZE} === '320x320'"))
    assert await says(page, "#trail", "/map · 320 \u00d7 320 in map")
    for _ in range(3):
        await page.page.get_by_role("button", name="Show more around it").click()

    async def pillars() -> bool:
        return await occupied(page) > 20

    await until(pillars)
    await page.page.select_option("#trail-map", "")
    assert await page.value(SIZE) == ""
    assert await occupied(page) == 0
    await page.page.select_option("#trail-map", "/map")
    await until(pillars)


NO_PERIODS = """
const { setTimeout: wait } = window;
window.setTimeout = (act, ms, ...more) => wait(act, ms === 500 || ms === 2000 ? 1e9 : ms, ...more);
"""
"""Nothing is asked for again."""


async def test_a_robot_is_asked_for_what_it_has_as_soon_as_it_is_there(site: Site) -> None:
    """Its panels and its state do not wait for the next time that a page asks by itself; nor when it comes back."""
    page = await site.open(script=NO_PERIODS)
    await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
    dropped = "(macsPage.headset.drop(), document.querySelector('#pad').getAttribute('aria-disabled'))"
    assert await page.value(dropped) == "true"
    await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)


async def test_a_plot_has_the_line_of_its_numbers(site: Site) -> None:
    """It is drawn, and grows: what is counted as a point is also seen."""
    page = await site.with_robot()
    # where the robot stands at 0, 0 the second line covers the first
    plot = "#plot--pose-pose-position-x-pose-position-y canvas"
    await page.page.wait_for_selector(plot)

    async def drawn(more_than: int) -> bool:
        return await coloured(page, plot, "--plot-2") > more_than

    await until(partial(drawn, 10))
    await until(partial(drawn, await coloured(page, plot, "--plot-2") + 10))


async def test_a_large_map_takes_little(site: Site) -> None:
    """Of 5000 by 3000 cells three by three share a pixel, and no occupied one is lost; what is no map is told."""
    page = await site.open()
    found: dict[str, Any] = await page.value("""import('/page/map.js').then(({ reduced }) => {
      const data = new Int8Array(5000 * 3000).fill(0);
      data[4999] = 100;              // the last cell of the first row
      data[2999 * 5000] = 77;        // the first one of the last row
      const { width, height, share, values } = reduced({ info: { width: 5000, height: 3000 }, data });
      const corner = [values[width - 1], values[(height - 1) * width]];
      const wrong = reduced({ info: { width: 5000, height: 3000 }, data: new Int8Array(7) });
      return { width, height, share, corner, others: values.filter((value) => value > 0).length, wrong };
    })""")
    assert found == {"width": 1667, "height": 1000, "share": 3, "corner": [100, 77], "others": 2, "wrong": None}


async def test_the_way_of_commands_is_shown(site: Site) -> None:
    """While somebody drives: from the headset's socket here to ROS; before that it says that nobody does."""
    page = await site.open("#latency")
    await page.page.wait_for_selector("#trace-topic option[value=commands]", state="attached", timeout=60_000)
    await page.page.select_option("#trace-topic", "commands")
    await until(lambda: says(page, "#trace-state", "somebody has to drive"))
    still = Types().serialize("geometry_msgs/msg/Twist", {})
    async with await Headset.connect("127.0.0.1", site.gateway.port) as headset:
        publisher = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[1])

        async def drive() -> None:
            while True:
                await publisher.publish(still, agents=[1])
                await asyncio.sleep(0.02)

        driving = asyncio.create_task(drive())
        try:
            await until(lambda: says(page, "#trace-state", "end to end"))
            names = await page.page.locator("#hops tbody tr td:first-child").all_inner_texts()
        finally:
            driving.cancel()
    assert names[0] == "this gateway: gateway"
    assert any("router" in name for name in names), names
    assert names[-1] == "robot 1: handled"
