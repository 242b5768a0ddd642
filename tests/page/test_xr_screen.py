"""The screen of the scene: the stop beside the settings, and what counts when nothing is drawn."""

from __future__ import annotations

import json
import re
from functools import partial

import pytest

pytest.importorskip("rclpy")  # the kit has a camera, which is a ROS node

from tests.page.conftest import Gate
from tests.page.headsets import UNDRAWN, headset_at, needs_headset
from tests.page.polls import until
from tests.support.browser import needs_browser

pytestmark = [needs_browser, needs_headset]

LOSE = "window.lose = macsXr.stage.renderer.getContext().getExtension('WEBGL_lose_context'), lose.loseContext()"
GIVEN = """
const bitmap = await createImageBitmap(new ImageData(8, 8));
macsXr.links.sight.onmessage({ data: { op: 'picture', key: 'one', bitmap, at: 0, stamp: 0 } });
const before = macsXr.frames;
"""


async def test_the_settings_leave_the_stop(gate: Gate) -> None:
    """While they are open nobody drives, and the stop is pressed by its button and by Escape, which closes them."""
    headset = await headset_at(gate, size=UNDRAWN)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    page, opened = headset.page, "document.querySelector('#settings').open"
    for stop in (partial(page.click, "#stop", timeout=5000), partial(page.press, "#setting-forward", "Escape")):
        await page.click("#open-settings")
        await until(lambda: headset.state("barred === 'the settings are open'"))
        await stop()
        await until(lambda: headset.value("macsXr.telling.stop.state !== 'free'"))
        await headset.value("(macsXr.release(), macsXr.release())")
        await until(lambda: headset.value("macsXr.telling.stop.state === 'free'"))
        if stop.func == page.click:
            await page.click("#settings button[type=submit]")
        assert await headset.value(opened) is False
        await until(lambda: headset.state("barred !== 'the settings are open'"))


async def test_what_is_not_drawn_is_not_shown(gate: Gate) -> None:
    """The browser takes the graphics away, or drawing fails: nobody drives, no picture counts as shown, and it is so
    until it is drawn again."""
    headset = await headset_at(gate, size=UNDRAWN)
    headset.watched.allowed.append(re.compile("Context Lost|fails"))
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    ways = {
        LOSE: "lose.restoreContext()",
        "macsXr.stage.render = () => { throw new Error('it fails'); }; 0": "delete macsXr.stage.render",
    }
    for away, back in ways.items():
        await headset.frame()
        await headset.value(away)
        await until(lambda: headset.state("barred.startsWith('nothing is drawn')"))
        await headset.value(f"(async () => {{ {GIVEN} }})()")
        await headset.frame(3)
        assert await headset.value("macsXr.links.pictureMs.length") == 0
        await headset.value(back)
        await until(lambda: headset.state("barred.startsWith('nothing is drawn') === false"))
        await until(
            lambda: headset.value("macsXr.links.pictureMs.splice(0).length > 0")
        )  # and the next one is asked for


ORDER = """(() => {
  const said = (window.said = []);
  const { links, stage, input } = macsXr;
  const noted = (object, name, word) => {
    const act = object[name];
    object[name] = (...what) => (said.push(word), act.apply(object, what));
  };
  noted(input, 'stops', 'frame'); // the first thing in each
  noted(links, 'input', 'hands');
  noted(stage, 'render', 'drawn');
})()"""
FAILS = "macsXr.stage.render = () => { throw new Error('it fails') }, 0"


async def test_what_hands_do_goes_out_before_the_frame_is_drawn(gate: Gate) -> None:
    """Nobody waits for the drawing to drive; and when a frame was not drawn, the next one says nothing of hands."""
    headset = await headset_at(gate, size=UNDRAWN)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    await headset.frame(3)
    await headset.value(ORDER)
    await until(lambda: headset.value("said.filter((each) => each === 'hands').length > 3"))
    frames = " ".join(await headset.value("said")).split("frame")
    told = {tuple(frame.split()) for frame in frames[1:-1] if "hands" in frame}
    assert told == {("hands", "drawn")}
    await headset.value(FAILS)
    await headset.frame(2)
    await headset.value("said.length = 0")
    await headset.frame(30)
    assert "hands" not in await headset.value("said")


UNHEARD = "document.querySelector('#stop-status').textContent.startsWith('THE STOP HAS NOT GONE OUT')"


async def test_a_press_that_nobody_hears_of_is_kept_and_said(gate: Gate) -> None:
    """The worker of commands is gone: the press is written down at once, an alarm says so, and the
    page that is loaded then goes on with it."""
    headset = await headset_at(gate, size=UNDRAWN)
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    await until(lambda: headset.state("connected"))
    await headset.value("macsXr.links.commands.terminate()")
    kept = json.loads(await headset.value("(macsXr.stop(), sessionStorage.getItem('macs.stop'))"))
    assert kept["all"] is True
    assert await headset.value("macsXr.telling.stop.state") == "waiting"
    await until(lambda: headset.value(UNHEARD))
    await headset.page.reload()
    await until(lambda: headset.value("Boolean(window.macsXr)"))
    await until(lambda: headset.state("connected"))
    await until(lambda: headset.state("barred !== 'nothing is known yet'"))
    await until(lambda: headset.value("macsXr.telling.stop.text === 'no robot is online: each that comes is stopped'"))
    await headset.value("(macsXr.release(), macsXr.release())")
    await until(lambda: headset.value("sessionStorage.getItem('macs.stop') === null"))
