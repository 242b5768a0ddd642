"""Who is not there drives nothing by what he holds, and neither does who comes back with it held."""

from __future__ import annotations

import asyncio
from functools import partial

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseStamped

from tests.page.conftest import Site
from tests.page.driving import Heard, heard_at
from tests.page.headsets import PATIENT_ROBOT, Headset, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser
from tests.support.ros_peer import Peer

pytestmark = [needs_browser, needs_headset]
RULES = PATIENT_ROBOT
"""The robot has no dead-man."""

OFF = "device.updateVisibilityState('hidden')"
ON = "device.updateVisibilityState('visible')"


async def take(headset: Headset) -> None:
    await headset.squeeze("right", held=True)
    await headset.stick("right", 0, -1)


async def stands(headset: Headset, heard: Heard, why: str) -> None:
    """It could be driven, its grip is held, and nothing drives."""
    await until(lambda: headset.state("barred === ''"))
    await headset.frame(10)
    assert await headset.state("held") is False, why
    assert not any(heard.speeds), why


async def test_what_was_taken_hold_of_meanwhile_does_not_drive(site: Site) -> None:
    """The grip is pressed while the headset is off, and while it is entered: it counts once it was let go of."""
    async with heard_at(site) as heard:
        headset = await headset_at(site, settings={"cameras": []})
        await headset.ready(pictures=False)
        await take(headset)
        await headset.enter()
        await stands(headset, heard, "held on entering")
        await headset.squeeze("right", held=False)
        await headset.frame(5)
        await headset.value(OFF)
        await until(lambda: headset.state("barred === 'the headset is off'"))
        await take(headset)
        await asyncio.sleep(0.2)
        await headset.value(ON)
        await stands(headset, heard, "pressed while it was off")
        await headset.drives(heard, partial(take, headset), partial(headset.squeeze, "right", held=False))


async def test_a_view_that_is_centred_anew_lets_go(site: Site) -> None:
    """All poses jump then: a zero, nothing drives that was held, and no pose goes out until something is taken hold
    of anew."""
    peer = Peer(site.domain)
    try:
        heads = await peer.subscription(PoseStamped, "/xr/head", 100)
        async with heard_at(site) as heard:
            headset = await headset_at(site, settings={"cameras": [], "head": "/xr/head"})
            await headset.ready(pictures=False)
            await headset.enter()
            let_go = partial(headset.squeeze, "right", held=False)
            await headset.drives(heard, partial(take, headset), let_go)
            await asyncio.wait_for(heads.get(), 60)
            await headset.value("device.recenter()")
            await until(lambda: heard.last == 0.0)
            heard.speeds.clear()
            await headset.frame(5)
            while not heads.empty():
                heads.get_nowait()
            await stands(headset, heard, "held while all moved")
            assert heads.empty(), "poses of another place"
            await let_go()
            await headset.drives(heard, partial(take, headset), let_go)
            await asyncio.wait_for(heads.get(), 60)
    finally:
        peer.session.close()
