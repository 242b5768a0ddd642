"""Recordings on the page: started, stopped, listed, downloaded; what happened in one, and a replay from there."""

from __future__ import annotations

from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path

import pytest

from bridge.recording.bag import Bag
from macs_zenoh.protocol.rights import Rights
from tests.page.conftest import StartSite, released, says, signed_in, with_token
from tests.page.polls import until
from tests.support.browser import needs_browser
from tests.support.programs import Program

pytest.importorskip("rclpy")
pytest.importorskip("mcap", reason="needs the extra record: pip install 'macs-zenoh[record]'")
pytestmark = [needs_browser, pytest.mark.timeout(240)]


def with_recorder(folder: Path) -> tuple[str, ...]:
    """Words for a gateway that has one."""
    settings = folder.with_suffix(".toml")
    settings.write_text(f'[gateway]\nrecordings = "{folder}"\n')
    return ("--settings", str(settings))


RECORDED = "/recording macs_[^·]*, \\d{2,} messages/.test(document.querySelector('#record-state').textContent)"


async def test_a_stop_is_recorded_found_and_played(start_site: StartSite, tmp_path: Path) -> None:
    """Somebody records, and presses the stop meanwhile; then the list has the file, whole; it is downloaded; what
    happened in it has the stop, and a click there plays it as another robot, which the page shows."""
    folder = tmp_path / "recordings"
    site = await start_site(with_recorder(folder))
    async with AsyncExitStack() as stack:
        words = ("--ring", "30s", "-e", site.endpoint)
        await stack.enter_async_context(Program("record", "--serve", str(folder), *words))
        watched = await site.with_robot()
        page = watched.page
        await page.click("a[href='#recordings']")
        await page.click("#record-start:enabled")
        await until(lambda: says(watched, "#record-state", "recording macs_"))
        # what a robot has is asked first: on a busy machine that takes longer than the stop of whoever is quick
        await until(partial(watched.value, RECORDED))
        await page.click("#stop")
        await until(lambda: says(watched, "#stop-status", "robot 1 stopped"))
        await released(watched)
        await page.click("#record-stop:enabled")
        row = await page.wait_for_selector("#recordings-list tr[data-state=whole]")
        assert row is not None
        name = await row.get_attribute("data-name")
        async with page.expect_download() as download:
            await page.click(f"tr[data-name='{name}'] a")
        path = Path(await (await download.value).path())
        assert path.read_bytes() == (folder / str(name)).read_bytes()
        with Bag(path) as bag:
            assert {"/1/camera/image/compressed", "/macs/stops"} <= {c.topic for c in bag.channels.values()}
        await page.click(f"tr[data-name='{name}'] .happened-button")
        await page.click("#happened li[data-kind=stop] .jump >> nth=0")
        link = await page.wait_for_selector("#replay-state a.replayed")
        assert link is not None
        assert await link.inner_text() == "robot 1 as 65001"
        await until(partial(watched.value, "macsPage.online.robots.includes(65001)"))
        await link.click()
        await page.wait_for_selector("#camera--camera-image-compressed canvas[data-shown]", timeout=60_000)
        await page.click("a[href='#recordings']")
        await page.click("#replay-stop")
        await until(partial(watched.value, "!macsPage.online.robots.includes(65001)"))
        await page.click("#record-ring:enabled")
        await page.wait_for_selector("#recordings-list tr[data-name^=ring_asked]", timeout=60_000)


async def test_the_tab_is_for_who_may_record(start_site: StartSite, tmp_path: Path) -> None:
    """A token without the right does not see it; with it, and without a recorder, the page says that there is none."""
    path = tmp_path / "tokens.json"
    sees, words = with_token(path, Rights(may=["see"], robots="any"), "sees")
    records, _ = with_token(path, Rights(may=["see", "record"], robots="any"), "records")
    site = await start_site((*words, *with_recorder(tmp_path / "recordings")))
    tab = "!!document.querySelector(\"a[href='#recordings']\")"
    assert await (await signed_in(site, sees)).value(tab) is False
    page = await signed_in(site, records)
    assert await page.value(tab) is True
    await page.page.click("a[href='#recordings']")
    await until(lambda: says(page, "#record-state", "the recorder does not answer"))
