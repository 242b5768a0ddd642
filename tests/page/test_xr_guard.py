"""Nobody drives without the picture that driving depends on: its camera dies, or what receives pictures never runs."""

from __future__ import annotations

import json
import re

import pytest

pytest.importorskip("rclpy")

from bridge.settings import ROBOT_HIDES
from tests.page.conftest import Site
from tests.page.headsets import PATIENT_ROBOT, PICTURES, Pictures, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser

pytestmark = [needs_browser, needs_headset]
RULES = f"""{PATIENT_ROBOT}
hide = {json.dumps([*ROBOT_HIDES, "/camera/**"])}
"""
"""The robot is patient, and has no picture of its own."""

OFFERED = f"'{PICTURES}' in macsXr.offers.publishers"
HERE = {"cameras": [PICTURES]}
BARRED_ALL = """
window.barred = new Set([macsXr.telling.state.barred]);
macsXr.links.addEventListener('state', ({ detail }) => window.barred.add(detail.barred));
"""
"""Notes each reason for which driving is off, and none."""


async def test_a_camera_that_dies_turns_driving_off(site: Site) -> None:
    """Its node leaves the graph: nobody offers the picture any more, and driving is off until it is back."""
    async with Pictures(site.domain):
        headset = await headset_at(site, settings=HERE)
        await headset.ready()
        await until(lambda: headset.value(OFFERED))
    await until(lambda: headset.value(f"!({OFFERED})"))
    await headset.frame(3)
    await until(lambda: headset.state("barred.startsWith('the picture is ')"))
    async with Pictures(site.domain):
        await until(lambda: headset.state("barred === ''"))


async def test_a_page_that_is_loaded_again_waits_for_the_picture_of_before(site: Site) -> None:
    """Nobody chose a picture: the first one guards. Its camera dies, and the page that is loaded then knows of it: the
    robot is none without pictures, and is not driven until they are back."""
    async with Pictures(site.domain):
        headset = await headset_at(site)
        await headset.ready()
    await until(lambda: headset.value(f"!({OFFERED})"))
    await headset.page.reload()
    await until(
        lambda: headset.value("Boolean(window.macsXr) && macsXr.drive !== undefined && macsXr.drive !== 'null'")
    )
    assert not await headset.value(OFFERED)
    await until(lambda: headset.state("barred === 'no picture has come yet'"))
    async with Pictures(site.domain):
        await until(lambda: headset.state("barred === ''"))


async def test_a_picture_that_is_said_again_and_again_is_none(site: Site) -> None:
    """A camera that hangs sends its last picture: it is one that has just come to who loads the page anew, and old."""
    async with Pictures(site.domain) as pictures:
        headset = await headset_at(site, settings=HERE)
        await headset.ready()
        pictures.repeat()
        await until(lambda: headset.state("barred.startsWith('the picture is ')"))
        await headset.page.reload()
        await until(lambda: headset.value("Boolean(window.macsXr?.target)"))
        await headset.value(BARRED_ALL)
        await until(lambda: headset.value("[...macsXr.room.screens.values()][0]?.shown > 2"))
        await headset.frame(10)
        assert "" not in await headset.value("[...window.barred]")
        assert await headset.state("barred") == "no picture has come yet"
        pictures.go_on()
        await until(lambda: headset.state("barred === ''"))


async def test_without_who_receives_pictures_nobody_drives(site: Site) -> None:
    """The worker of pictures does not load: of the picture that guards nothing is heard, and driving is off."""
    async with Pictures(site.domain):
        headset = await headset_at(site, settings=HERE)
        headset.watched.allowed.append(re.compile("sight-worker|ERR_FAILED"))
        await headset.ready()
        await headset.page.route("**/xr/sight-worker.js", lambda route: route.abort())
        await headset.page.reload()
        await until(lambda: headset.value(f"Boolean(window.macsXr) && {OFFERED} && macsXr.drive !== 'null'"))
        await until(lambda: headset.state("barred === 'no picture has come yet'"))
