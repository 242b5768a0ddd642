"""The page tells its robot when each command was made, so that an old one is never carried out."""

from __future__ import annotations

from functools import partial

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import HELD, Site, StartSite, driven, says
from tests.page.driving import heard_at, hold, pointer
from tests.page.headsets import PATIENT_ROBOT
from tests.page.polls import until
from tests.support.browser import Watched, needs_browser

pytestmark = needs_browser
RULES = PATIENT_ROBOT
"""On a busy machine commands get old."""
NO_AGE = "[robot]\nmax_timed_command_age_s = 0.0001\n"
"""No command is so young."""

NODE = "macsPage.headset.nodes.find((node) => node.name === '/cmd_vel' && node.nodeType === 2)"
LATE_KEY = """(late) => {
  const event = new KeyboardEvent('keydown', { code: 'KeyW', bubbles: true, cancelable: true });
  Object.defineProperty(event, 'timeStamp', { value: performance.now() - late });
  document.querySelector('#pad').dispatchEvent(event);
}"""


async def holding_says(page: Watched, words: str) -> bool:
    """Whether the pad says so while somebody holds it, anew where a busy machine lets the page stand still."""
    said = await says(page, "#drive-hint", words)
    if not said and not await page.value(HELD):
        await page.page.mouse.up()
        await hold(page)
    return said


async def test_commands_tell_when_they_were_made(site: Site) -> None:
    """By a clock that the robot has compared with its own; the page says how old they may be."""
    page = await site.with_robot()
    await until(lambda: says(page, "#drive", "Commands at most 10 s old"))
    await driven(page, *pointer(page))
    await page.page.mouse.up()
    assert await page.value(f"{NODE}.lastTicks") > 0


async def test_a_command_that_is_too_old_is_refused_in_words(start_site: StartSite) -> None:
    """Nothing of it is carried out, the hold ends, and the pad says why."""
    site = await start_site(rules=NO_AGE)
    async with heard_at(site) as heard:
        page = await site.with_robot()
        await until(partial(holding_says, page, "the command came too late: it may be "), every_s=0.2)
        assert not await page.value(HELD)

        async def told() -> bool:
            """Of the zero that ends a hold; anew where who listens had not yet heard of who says it."""
            await page.page.mouse.up()
            if 0.0 not in heard.speeds:
                await hold(page)
            return 0.0 in heard.speeds

        await until(told, every_s=0.5)  # sent after all of them
        assert not any(heard.speeds)


async def test_a_clock_that_says_nothing_is_told(site: Site) -> None:
    """The page does not answer what time it is: the robot refuses a time that it cannot judge, and the pad is off and
    says so until it is answered."""
    page = await site.with_robot()
    await page.value("macsPage.clock.ticks.answer = () => null; undefined")
    await until(partial(holding_says, page, "has not compared clocks yet"), every_s=0.2)
    assert await page.page.get_attribute("#pad", "aria-disabled") == "true"
    await page.page.mouse.up()
    await page.value("delete macsPage.clock.ticks.answer")
    await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)


async def test_what_was_done_long_ago_takes_hold_of_nothing(site: Site) -> None:
    """A key that was pressed while the page stood still, and is heard of only now."""
    page = await site.with_robot()
    await page.page.focus("#pad")
    await page.page.evaluate(LATE_KEY, 400)
    await page.value("new Promise((done) => setTimeout(done, 120))")
    assert not await page.value(HELD)

    async def held() -> bool:
        await page.page.keyboard.up("KeyW")  # one that was lost while the page stood still has to be pressed anew
        await page.page.evaluate(LATE_KEY, 0)
        return bool(await page.value(f"new Promise((done) => setTimeout(() => done({HELD}), 50))"))

    await until(held, every_s=0.05)
    await page.page.keyboard.up("KeyW")
    await until(partial(page.value, f"!{HELD}"))
