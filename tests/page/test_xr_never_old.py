"""No command on what is old: pictures that freeze, somebody who is not there, a scene that hangs.

With a real robot that keeps its last speed, so that every zero is the headset's."""

from __future__ import annotations

import asyncio
import os
import signal
import time
from functools import partial

import pytest

pytest.importorskip("rclpy")

from tests.page.conftest import Site
from tests.page.driving import heard_at
from tests.page.headsets import PATIENT_ROBOT, PICTURES, UNDRAWN, Pictures, by_grip, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser

pytestmark = [needs_browser, needs_headset]
RULES = PATIENT_ROBOT
"""The robot has no dead-man."""

LOCKOUT_S = float(os.environ.get("MACS_LOCKOUT_S", "1.0"))
"""Longer than its default: on a busy machine pictures come late without being frozen."""


async def test_a_frozen_picture_turns_driving_off(site: Site) -> None:
    """Pictures stop while it drives: a zero, no command after that, the panel says why; and it
    comes back by itself with them, to be taken hold of anew."""
    async with heard_at(site) as heard, Pictures(site.domain) as pictures:
        headset = await headset_at(site, settings={"cameras": [PICTURES], "lockoutS": LOCKOUT_S, "hz": 60})
        await headset.ready()
        await headset.enter()
        take, let_go = by_grip(headset)
        await headset.drives(heard, take, let_go)
        froze_at = pictures.freeze()
        await until(lambda: heard.last == 0.0)
        took_s = heard.stopped_at - froze_at
        after = len(heard.speeds)
        await until(lambda: headset.state("barred.includes('the picture is')"))
        await until(lambda: headset.value("macsXr.room.screens.get('/test/picture').veil.mesh.visible"))
        await headset.shot("frozen")
        await headset.frame(20)
        assert set(heard.speeds[after:]) <= {0.0}, "a command on an old picture"
        print(f"driving off {took_s * 1000:.0f} ms after the last picture, by its receiver's clock")
        pictures.go_on()
        await until(lambda: headset.state("barred === ''"))
        await headset.frame(10)
        assert set(heard.speeds[after:]) <= {0.0}, "held since before it was off"
        await headset.drives(heard, take, let_go)
        pictures.repeat()  # the same picture again and again
        await until(lambda: heard.last == 0.0)
        await let_go()


HIDE = "Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
SHOW = "delete document.hidden;"
TELL = "document.dispatchEvent(new Event('visibilitychange'))"

AIMED = "macsXr.links.aim({...macsXr.target, topic: '/cmd_vel', type: 'geometry_msgs/msg/Twist'})"
WAYS = {
    "headset_off": ("device.updateVisibilityState('hidden')", "device.updateVisibilityState('visible')"),
    "menu_opened": ("device.updateVisibilityState('visible-blurred')", "device.updateVisibilityState('visible')"),
    "scene_hangs": ("{ const end = Date.now() + 700; while (Date.now() < end); }", ""),
    "no_robot": ("macsXr.links.aim(null)", AIMED),
    "xr_ends": ("macsXr.immersion.leave()", ""),
}


WHY = {
    "headset_off": {"the headset is off"},
    "menu_opened": {"the headset is off"},
    "scene_hangs": {"the headset stood still"},
    "no_robot": {"another robot was chosen"},
    "xr_ends": {"the headset is off", "the headset was put on or off", "the headset stood still"},
}
"""What ends it, and nothing that a busy machine does meanwhile."""


async def test_who_wears_it_no_more_has_let_go(site: Site) -> None:
    """Taken off, its menu opened, hung, the robot given up, XR left: each ends with a zero, and nothing drives that
    was not taken hold of anew."""
    async with heard_at(site) as heard:
        headset = await headset_at(site, settings={"cameras": []}, size=UNDRAWN)
        await headset.ready(pictures=False)
        await headset.enter()
        take, let_go = by_grip(headset)
        for name, (away, back) in WAYS.items():
            for _ in range(8):  # on a busy machine the scene stands still at times, which ends it as well
                await headset.drives(heard, take, let_go)
                await headset.value(away)
                await until(lambda: heard.last == 0.0)
                after = len(heard.speeds)
                await until(lambda: headset.state("held === false"))
                why = await headset.state("why")
                if why in WHY[name] or name == "xr_ends":
                    break
                await headset.value(back)
                await let_go()
                await until(lambda: headset.state("barred === ''"))
            assert why in WHY[name], name
            if back:
                await headset.value(back)
                await until(lambda: headset.state("barred === ''"))
            await headset.frame(5)
            assert set(heard.speeds[after:]) <= {0.0}, name
            await let_go()
        await until(lambda: headset.value("!macsXr.stage.immersive"))


async def test_a_page_that_nobody_sees_has_let_go(site: Site) -> None:
    """The same on a screen: driven by keys, and the page is hidden, or the window loses the focus."""
    async with heard_at(site) as heard:
        headset = await headset_at(site, settings={"cameras": []}, size=UNDRAWN)
        await headset.ready(pictures=False)
        keys = headset.page.keyboard
        for name, away, back in (
            ("hidden", HIDE + TELL, SHOW + TELL),
            ("blurred", "window.dispatchEvent(new Event('blur'))", ""),
        ):
            await headset.page.focus("#pad")
            await headset.drives(heard, partial(keys.down, "KeyW"), partial(keys.up, "KeyW"))
            await headset.value(away)
            await until(lambda: heard.last == 0.0)
            after = len(heard.speeds)
            if back:
                await headset.value(back)
            await headset.frame(5)
            assert set(heard.speeds[after:]) <= {0.0}, name
            await keys.up("KeyW")


async def test_a_gateway_that_stands_still_gets_no_more(site: Site) -> None:
    """Nothing goes into a network that does not answer, and when it does, the robot is told to stand."""
    async with heard_at(site) as heard:
        headset = await headset_at(site, settings={"cameras": []}, size=UNDRAWN)
        await headset.ready(pictures=False)
        await headset.enter()
        take, let_go = by_grip(headset)
        await headset.drives(heard, take, let_go)
        site.gateway.send_signal(signal.SIGSTOP)
        try:
            await until(lambda: headset.state("held === false"))
            await asyncio.sleep(0.5)
        finally:
            site.gateway.send_signal(signal.SIGCONT)
        began = time.monotonic()
        await until(lambda: heard.last == 0.0)
        after = len(heard.speeds)
        await headset.frame(10)
        assert set(heard.speeds[after:]) <= {0.0}
        assert time.monotonic() - began < 60
        await let_go()
