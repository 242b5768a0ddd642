"""The pad's hold in a real browser, with a real robot that has no dead-man: each way to let go ends with a zero,
and nothing drives again that was not taken hold of anew."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from pathlib import Path

import pytest
import pytest_asyncio

pytest.importorskip("rclpy")

from macs_zenoh.protocol.rights import Rights
from tests.page.conftest import HELD, Site, StartSite, released, says, signed_in, with_token
from tests.page.driving import GAMEPAD, GAMEPAD_HELD, NO_GAMEPAD, Heard, face_buttons, heard_at, hold
from tests.page.polls import until
from tests.support.browser import Watched, needs_browser

pytestmark = needs_browser
RULES = ""
"""The robot keeps its last speed, whatever happens."""


@pytest_asyncio.fixture(loop_scope="session")
async def heard(site: Site) -> AsyncIterator[Heard]:
    """What its robot is told."""
    async with heard_at(site) as heard:
        yield heard


async def drives(page: Watched, heard: Heard, take: Callable[[], Awaitable[object]]) -> None:
    """Take hold until the robot is told to go; anew where a busy machine lets the page stand still."""
    heard.speeds.clear()

    async def told() -> bool:
        if not await page.value(HELD):
            await page.page.mouse.up()
            await page.page.keyboard.up("ArrowUp")
            await take()
        return len(heard.speeds) > 3 and heard.last is not None and heard.last > 0

    await until(told, every_s=0.05)


async def stands(page: Watched, heard: Heard) -> None:
    """It was let go of: the last command is a zero, and none that drives follows."""
    await until(lambda: heard.last == 0.0)
    await until(partial(page.value, f"!{HELD}"))
    after = len(heard.speeds)
    for _ in range(10):  # frames and ticks in which it could be taken again
        await page.value("new Promise((done) => setTimeout(() => requestAnimationFrame(done), 60))")
    assert set(heard.speeds[after:]) <= {0.0}


async def by_key(page: Watched) -> None:
    await page.page.focus("#pad")
    await page.page.keyboard.down("ArrowUp")


async def test_a_modifier_key_ends_a_hold(site: Site, heard: Heard) -> None:
    """Pressed while a key drives, each ends it at once, and the key's end, told with the modifier, is its end."""
    page = await site.with_robot()
    for modifier in ("Control", "Alt", "Meta"):
        await drives(page, heard, partial(by_key, page))
        await page.page.keyboard.down(modifier)
        await stands(page, heard)
        await page.page.keyboard.up("ArrowUp")
        await page.page.keyboard.up(modifier)
    await drives(page, heard, partial(by_key, page))
    await page.page.keyboard.up("ArrowUp")
    await stands(page, heard)


async def test_a_pad_that_loses_the_focus_ends_a_hold(site: Site, heard: Heard) -> None:
    """By keys: who types elsewhere drives nothing, whatever key is down."""
    page = await site.with_robot()
    await drives(page, heard, partial(by_key, page))
    await page.value("document.querySelector('#pad').blur()")
    await stands(page, heard)
    await page.page.keyboard.up("ArrowUp")


async def test_the_first_button_ends_a_hold_while_another_is_down(site: Site, heard: Heard) -> None:
    """Browsers tell the end of one button as a move while another is down."""
    page = await site.with_robot()
    await drives(page, heard, partial(hold, page))
    await page.page.mouse.down(button="right")
    await page.page.mouse.up(button="left")
    await stands(page, heard)
    await page.page.mouse.up(button="right")


async def test_another_view_ends_a_hold(site: Site, heard: Heard) -> None:
    """By keys and by a gamepad; who comes back with its button held has to press it anew."""
    page = await site.with_robot()
    await drives(page, heard, partial(by_key, page))
    await page.value("location.hash = 'mesh'")
    await stands(page, heard)
    await page.page.keyboard.up("ArrowUp")
    await page.value("location.hash = 'robot'")
    await drives(page, heard, partial(page.value, GAMEPAD))
    await page.value("location.hash = 'mesh'")
    await stands(page, heard)
    await page.value("location.hash = 'robot'")
    await stands(page, heard)
    await page.value("location.hash = 'mesh'")
    await page.value(NO_GAMEPAD)
    await page.value(GAMEPAD)
    await page.value("location.hash = 'robot'")
    await stands(page, heard)
    await page.value(NO_GAMEPAD)


async def test_a_gamepad_s_button_held_drives_no_other_robot(site: Site, heard: Heard) -> None:
    """Nor the same one whose panel is made anew while it is held."""
    page = await site.with_robot()
    await drives(page, heard, partial(page.value, GAMEPAD))
    await page.value("macsPage.robotView.choose(2)")
    await until(lambda: heard.last == 0.0)
    await page.value("macsPage.robotView.choose(1)")
    await page.page.wait_for_selector('#pad[aria-disabled="false"]')
    await stands(page, heard)


async def test_a_gamepad_that_comes_with_its_button_held_drives_nothing(site: Site, heard: Heard) -> None:
    """Who plugs it in, or wakes it up, has to let go of it first, and that be seen."""
    page = await site.with_robot()
    heard.speeds.clear()
    await page.value(GAMEPAD_HELD)
    await page.value("new Promise((done) => setTimeout(() => requestAnimationFrame(done), 400))")
    assert not await page.value(HELD)
    assert not any(heard.speeds)
    await drives(page, heard, partial(page.value, GAMEPAD))
    await page.value(NO_GAMEPAD)
    await stands(page, heard)


async def test_a_pressed_stop_ends_a_hold(site: Site, heard: Heard) -> None:
    """At once, and not when the robot has confirmed it."""
    page = await site.with_robot()
    await drives(page, heard, partial(hold, page))
    site.agent.send_signal(signal.SIGSTOP)
    try:
        await page.page.keyboard.press("Escape")
        await until(lambda: says(page, "#drive-hint", "A stop is pressed"))
        assert not await page.value(HELD)
    finally:
        site.agent.send_signal(signal.SIGCONT)
    await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
    await page.page.mouse.up()
    await released(page)


async def test_two_buttons_of_a_gamepad_stop(site: Site, heard: Heard) -> None:
    """A and B together, in any view and while it drives: each press once, and neither of them alone."""
    page = await site.with_robot()
    await drives(page, heard, partial(page.value, GAMEPAD))
    for alone in ({"a": True, "b": False}, {"a": False, "b": True}):
        await page.value(face_buttons(**alone))
        assert not await page.value("macsPage.stop.open || macsPage.stop.stopped().length")
    await page.value(face_buttons(a=True, b=True))
    await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
    await stands(page, heard)
    await released(page)
    await page.value("new Promise((done) => setTimeout(done, 400))")
    assert not await page.value("macsPage.stop.open"), "held since before it was released"
    await page.value("location.hash = 'mesh'")
    await page.value(face_buttons(a=False, b=False))
    await page.value(face_buttons(a=True, b=True))
    await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
    await page.value(NO_GAMEPAD)
    await released(page)
    await page.value("location.hash = 'robot'")


async def test_a_zero_comes_through_a_network_that_stood_still(site: Site, heard: Heard) -> None:
    """Let go of while the gateway does not answer: when it does, the robot is told to stand."""
    page = await site.with_robot()
    for _ in range(2):
        await drives(page, heard, partial(hold, page))
        site.gateway.send_signal(signal.SIGSTOP)
        try:
            await page.page.mouse.up()
            await asyncio.sleep(1.5)  # so old that a gateway throws it away
        finally:
            site.gateway.send_signal(signal.SIGCONT)
        await page.page.wait_for_selector('#pad[aria-disabled="false"]')
        await stands(page, heard)


async def test_a_zero_comes_for_a_panel_that_is_gone(site: Site, heard: Heard) -> None:
    """The connection is cut while it drives, and another robot chosen before it is back."""
    page = await site.with_robot()
    find = "macsPage.headset.nodes.find((node) => node.name === '/cmd_vel')"
    was_held = False
    while not was_held:  # on a busy machine the page may have stood still just then, and have let go
        await page.value("macsPage.robotView.choose(1)")
        await drives(page, heard, partial(hold, page))
        before = await page.value(f"(window.commands = {find}).unsent")  # it may be gone when it has sent the zero
        was_held = await page.value(f"was = {HELD}; macsPage.headset.drop(); macsPage.robotView.choose(2); was")
        await page.page.mouse.up()
        await until(partial(page.value, "macsPage.headset.connected"))
        await until(lambda: heard.last == 0.0)
    assert await page.value("commands.unsent") > before
    await until(partial(page.value, f"!{find}?.robots.size"))


async def test_a_robot_that_drops_out_is_not_driven_on(site: Site, heard: Heard) -> None:
    """It leaves while it is driven: the hold ends, and when it is back, with the button still held, it stands."""
    page = await site.with_robot()
    await drives(page, heard, partial(hold, page))
    site.agent.send_signal(signal.SIGSTOP)
    try:
        await until(lambda: says(page, "#drive-hint", "not online"))
        assert not await page.value(HELD)
    finally:
        site.agent.send_signal(signal.SIGCONT)
    await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
    await stands(page, heard)
    await page.page.mouse.up()


async def test_a_refused_command_ends_a_hold(start_site: StartSite, tmp_path: Path) -> None:
    """A token that is not for the topic of the commands: the pad says so, and does not seem to drive."""
    rights = Rights(may=["see", "command"], robots="any", topics=["/pose"])
    secret, words = with_token(tmp_path / "tokens.json", rights)
    page = await signed_in(await start_site(words), secret)
    await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
    await hold(page)
    await until(lambda: says(page, "#drive-hint", "its registration was refused"))
    assert not await page.value(HELD)
    await page.page.mouse.up()
