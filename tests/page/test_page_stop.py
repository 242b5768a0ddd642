"""The page's stop with robots that are away: what was pressed is never forgotten, and what is said of it is so."""

from __future__ import annotations

import signal
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path

import pytest

from macs_zenoh.protocol.rights import Rights
from tests.page.conftest import DOMAINS, Site, StartSite, released, says, signed_in, with_token
from tests.page.polls import until
from tests.support.browser import OFFLINE, Watched, needs_browser
from tests.support.programs import Program

pytest.importorskip("rclpy")
pytestmark = needs_browser


def second_agent(site: Site) -> Program:
    """Of robot 2, on a graph of its own."""
    return Program("agent", "--id", "2", "-e", site.endpoint, env={"ROS_DOMAIN_ID": str(site.domain + DOMAINS)})


async def online(page: Watched, *robots: int) -> None:
    """Wait until the page knows these, and no others."""
    await until(partial(page.value, f"String(window.macsPage?.online.robots) === '{','.join(map(str, robots))}'"))


async def is_missed(page: Watched) -> bool:
    """Whether the page says that it waits for robot 2, of which it knows a moment later that it is away."""
    said = await page.page.inner_text("#stop-status")
    return "no confirmation yet of robot 2" in said or "robot 2 not online" in said


async def test_a_press_holds_for_a_robot_that_drops_out(site: Site) -> None:
    """Robot 2 stands still before it confirms, and is not online when somebody presses again: it is stopped as
    soon as it is back, and until then nobody says that all of them are."""
    async with AsyncExitStack() as stack:
        other = await stack.enter_async_context(second_agent(site))
        page = await site.open()
        await online(page, 1, 2)
        other.send_signal(signal.SIGSTOP)
        try:
            await page.page.click("#stop")
            await until(partial(is_missed, page))
            await online(page, 1)
            await page.page.click("#stop")
            await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
            await until(lambda: says(page, "#stop-status", "robot 2 not online: stopped on return"))
            assert await page.page.get_attribute(".stop-bar", "data-state") == "waiting"
        finally:
            other.send_signal(signal.SIGCONT)
        await until(lambda: says(page, "#stop-status", "robot 1, 2 stopped"))
        await released(page)


async def test_a_press_holds_where_no_robot_is_known(site: Site) -> None:
    """Connected, and none is online: it is said so; who comes is stopped, one and all. A page that is loaded
    anew meanwhile goes on with it."""
    await site.agent.stop(signal.SIGKILL)
    page = await site.open()
    page.allowed.append(OFFLINE)
    await until(partial(page.value, "window.macsPage?.headset.connected"))
    await online(page)
    await page.page.click("#stop")
    await until(lambda: says(page, "#stop-status", "no robot is online: each that comes is stopped"))
    page.page.on("dialog", lambda dialog: dialog.accept())
    await page.page.reload()
    await until(lambda: says(page, "#stop-status", "no robot is online: each that comes is stopped"))
    await site.agent.start()
    await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
    async with second_agent(site):
        await until(lambda: says(page, "#stop-status", "robot 1, 2 stopped"))
        await released(page)
    assert await page.value("sessionStorage.getItem('macs.stop')") is None


async def test_a_press_that_was_taken_back_is_not_sent(site: Site) -> None:
    """Pressed while there is no robot, and released: who comes then may go on."""
    await site.agent.stop(signal.SIGKILL)
    page = await site.open()
    await until(partial(page.value, "window.macsPage?.headset.connected"))
    await online(page)
    await page.page.click("#stop")
    await released(page)
    await site.agent.start()
    await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
    assert await page.value("macsPage.stop.stopped().length") == 0


async def test_a_token_for_groups_stops_their_robots(start_site: StartSite, tmp_path: Path) -> None:
    """A robot that it may name by its group only is stopped and released, also when it was away; nothing else of the
    page pretends to be for it. For one group, and for any."""
    path, secrets = tmp_path / "tokens.json", list[str]()
    for name, groups in (("three", [3]), ("any", "any")):
        rights = Rights(may=["see", "stop", "command"], robots=[], groups=groups)  # type: ignore[arg-type]
        secret, words = with_token(path, rights, name)
        secrets.append(secret)
    site = await start_site(words, agent=("--group", "3"))
    for secret in secrets:
        page = await signed_in(site, secret)
        await online(page, 1)
        said = await page.page.inner_text(".robot-view")
        assert "by their group" in said
        assert "gives control to who may name it by its number" in said
        await page.page.click("#stop")
        await until(lambda page=page: says(page, "#stop-status", "robot 1 stopped"))
        await released(page)
        await site.agent.stop(signal.SIGKILL)
        await online(page)
        await page.page.click("#stop")
        await until(lambda page=page: says(page, "#stop-status", "robot 1 not online: stopped on return"))
        await site.agent.start()
        await until(lambda page=page: says(page, "#stop-status", "robot 1 stopped"))
        await released(page)


async def test_a_stop_holds_on_a_robot_that_starts_anew(site: Site) -> None:
    """Its program ends after it has confirmed, and comes back holding nothing: it is stopped again."""
    page = await site.open()
    await online(page, 1)
    await page.page.click("#stop")
    await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
    await site.agent.stop(signal.SIGKILL)
    await online(page)
    await site.agent.start()
    await online(page, 1)
    await until(lambda: says(page, "#stop-status", "robot 1 stopped"))
    said = "fetch('/view/robots/1/status').then((r) => r.json()).then((s) => s.stopped === true)"
    await until(lambda: page.value(said))
    await released(page)
