"""Nobody drives without the picture that driving depends on: its camera dies, or what receives pictures never runs."""

from __future__ import annotations

import re

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import Site
from tests.page.headsets import PATIENT_ROBOT, PICTURES, Pictures, headset_at, needs_headset
from tests.support.browser import needs_browser
from tests.support.waiting import until

pytestmark = [needs_browser, needs_headset]
RULES = PATIENT_ROBOT
"""The robot is patient."""

OFFERED = f"'{PICTURES}' in macsXr.offers.publishers"
HERE = {"cameras": [PICTURES]}


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
