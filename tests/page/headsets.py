"""Headsets in a browser: a Chromium with WebGL, in which `iwer` plays a Quest 3 that tests move."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.page.conftest import Site
from tests.support.browser import ROOT, SCREENSHOTS, Watched, browser, opened
from tests.support.waiting import until

IWER = ROOT / "build" / "npm" / "node_modules" / "iwer" / "build" / "iwer.min.js"
WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
needs_headset = pytest.mark.skipif(not IWER.is_file(), reason="the WebXR emulator is missing: make page")

DEVICE = """
const device = new IWER.XRDevice(IWER.metaQuest3, { ipd: 0.064 });
device.installRuntime({ forceInstall: true }); // Chromium has one, without a headset
device.position.set(0, 1.6, 0.2);
window.device = device;
"""
PLACE = """([name, [x, y, z], q]) => {
  const hand = name.endsWith('Hand') ? device.hands[name.slice(0, -4)] : device.controllers[name];
  const one = name === 'head' ? device : hand;
  one.position.set(x, y, z);
  if (q) one.quaternion.set(...q);
}"""


class Headset:
    """One of them, at a page."""

    def __init__(self, watched: Watched) -> None:
        self.watched = watched
        self.page = watched.page

    async def value(self, script: str, argument: Any = None) -> Any:
        """What JavaScript gives in the page."""
        return await self.page.evaluate(script, argument)

    async def ready(self, *, pictures: bool = True) -> None:
        """Wait until the robot can be driven, with its picture in the panel."""
        await until(lambda: self.value("Boolean(window.macsXr?.target)"))
        if pictures:
            await until(lambda: self.value("[...macsXr.room.screens.values()][0]?.shown > 0"))
        await until(lambda: self.value("macsXr.telling.state.barred === ''"))

    async def enter(self, mode: str = "immersive-vr") -> None:
        """Press the button that enters XR."""
        await self.page.click(f"#{mode}")
        await until(lambda: self.value("Boolean(macsXr.immersion.session) && macsXr.stage.immersive"))

    async def leave(self) -> None:
        """Take it off."""
        await self.value("macsXr.immersion.leave()")
        await until(lambda: self.value("!macsXr.stage.immersive"))

    async def place(self, name: str, at: Sequence[float], turned: Sequence[float] | None = None) -> None:
        """Put ``head``, a controller (``left``) or a hand (``leftHand``) somewhere, by WebXR's axes."""
        await self.value(PLACE, [name, list(at), list(turned) if turned else None])

    async def squeeze(self, hand: str, held: bool) -> None:
        """The grip of a controller."""
        await self.value(
            "([hand, value]) => device.controllers[hand].updateButtonValue('squeeze', value)", [hand, int(held)]
        )

    async def trigger(self, hand: str, held: bool) -> None:
        """The trigger of a controller."""
        await self.value(
            "([hand, value]) => device.controllers[hand].updateButtonValue('trigger', value)", [hand, int(held)]
        )

    async def button(self, hand: str, name: str, held: bool) -> None:
        """A button as ``a-button``."""
        script = "([hand, name, value]) => device.controllers[hand].updateButtonValue(name, value)"
        await self.value(script, [hand, name, int(held)])

    async def stick(self, hand: str, x: float, y: float) -> None:
        """The thumbstick: right and back are positive, as browsers have it."""
        script = "([hand, x, y]) => device.controllers[hand].updateAxes('thumbstick', x, y)"
        await self.value(script, [hand, x, y])

    async def pinch(self, hand: str, amount: float) -> None:
        """Close thumb and index finger."""
        await self.value(
            "([hand, value]) => { device.primaryInputMode = 'hand'; device.hands[hand].updatePinchValue(value) }",
            [hand, amount],
        )

    async def state(self, name: str) -> Any:
        """What the worker of commands says."""
        return await self.value(f"macsXr.telling.state.{name}")

    async def shot(self, name: str) -> Path:
        """A picture of what is seen."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        path = SCREENSHOTS / f"xr-{name}.png"
        await self.page.screenshot(path=path)
        return path


@asynccontextmanager
async def with_webgl(site: Site) -> AsyncIterator[Site]:
    """A site whose browser has WebGL."""
    async with browser(*WEBGL) as found:
        site.browser = found
        yield site


async def headset_at(site: Site, path: str = "xr", script: str = "", **options: Any) -> Headset:
    """A headset that has opened the scene."""
    options = {"viewport": {"width": 1280, "height": 800}, **options}
    context = await site.browser.new_context(**options)
    await context.add_init_script(path=IWER)
    await context.add_init_script(script=DEVICE + script)
    watched = await opened(context, site.url + path)
    site.pages.append(watched)
    return Headset(watched)


def about_up(radians: float) -> tuple[float, float, float, float]:
    """The quaternion of a turn to the left."""
    return 0.0, math.sin(radians / 2), 0.0, math.cos(radians / 2)


async def pause(seconds: float) -> None:
    """For what must not happen meanwhile."""
    await asyncio.sleep(seconds)
