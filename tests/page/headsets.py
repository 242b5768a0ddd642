"""Headsets in a browser: a Chromium with WebGL, in which `iwer` plays a Quest 3 that tests move."""

from __future__ import annotations

import array
import asyncio
import json
import math
import struct
import time
import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CompressedImage

from tests.page.conftest import Act, Gate, Site
from tests.page.driving import Heard
from tests.page.polls import until
from tests.support.browser import ROOT, SCREENSHOTS, SLOWER, Watched, opened
from tests.support.devtools import LonePage
from tests.support.ros_peer import Peer

if TYPE_CHECKING:
    from playwright.async_api import Page

IWER = ROOT / "build" / "npm" / "node_modules" / "iwer" / "build" / "iwer.min.js"
needs_headset = pytest.mark.skipif(not IWER.is_file(), reason="the WebXR emulator is missing: make page")

DEVICE = """
const device = new IWER.XRDevice(IWER.metaQuest3, { ipd: 0.064 });
device.installRuntime({ forceInstall: true }); // Chromium has one, without a headset
device.position.set(0, 1.6, 0.2);
window.device = device;
"""
LOOKED_AT = """
const [width, height] = %s;
Object.assign(window, { innerWidth: width, innerHeight: height, looking: false });
Object.defineProperty(window, 'devicePixelRatio', { value: width / 640 });
for (const { prototype } of [WebGLRenderingContext, WebGL2RenderingContext]) {
  const { drawElements, drawArrays, getParameter } = prototype;
  const cleared = new Map([[0x0c22, new Float32Array(4)], [0x0b73, 1], [0x0b91, 0]]);
  prototype.getParameter = function (name) {
    return cleared.get(name) ?? getParameter.call(this, name);
  };
  prototype.drawElements = function (mode, count, ...at) {
    drawElements.call(this, mode, looking ? count : Math.min(count, 3), ...at);
  };
  prototype.drawArrays = function (mode, first, count) {
    drawArrays.call(this, mode, first, looking ? count : Math.min(count, 3));
  };
}
window.look = (whether) => {
  looking = whether;
  if (!macsXr.stage.immersive) macsXr.stage.renderer.setPixelRatio(whether ? 1 : devicePixelRatio);
};
"""
"""Of what is drawn one triangle each time, but in the frames that a test looks at: what graphics hardware does in a
headset costs the processor next to nothing then, and what the scene does for it is the same. Nor does the emulator
wait three times a frame until all is drawn, to ask what a picture is cleared with, which no headset does."""
SMALL = LOOKED_AT % "[320, 210]"
"""As large as the eyes of the emulated device are then: without graphics hardware each pixel costs the processor, and
who drives has to be confirmed five times a second by a frame."""
UNDRAWN = LOOKED_AT % "[32, 32]"
"""For tests that look at no pixel."""
PICTURES = "/test/picture"
PATIENT_ROBOT = """
[robot]
max_timed_command_age_s = 10.0
"""
"""Where a test is not about it: on a busy machine commands get old."""
PATIENT = {"lockoutS": 5}
"""Settings of tests that are about something else: a machine that draws by its processor is slow at times."""

PIXELS = """([across, down, size]) => new Promise((done) => {
  const { stage } = macsXr;
  const render = Object.getPrototypeOf(stage).render;
  stage.render = () => {
    look(true);
    render.call(stage);
    delete stage.render;
    const gl = stage.renderer.getContext();
    const pixels = new Uint8Array(4 * size * size);
    const [x, y] = [gl.drawingBufferWidth * across, gl.drawingBufferHeight * (1 - down)].map(Math.round);
    gl.readPixels(x - size / 2, y - size / 2, size, size, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    look(false);
    done(Array.from(pixels));
  };
})"""
PLACE = """([name, [x, y, z], q]) => {
  const hand = name.endsWith('Hand') ? device.hands[name.slice(0, -4)] : device.controllers[name];
  const one = name === 'head' ? device : hand;
  one.position.set(x, y, z);
  if (q) one.quaternion.set(...q);
}"""


class Headset:
    """One of them, at a page."""

    def __init__(self, page: Page | LonePage, watched: Watched | None = None) -> None:
        self.page = page
        self.watched = watched
        """Whoever takes note of what goes wrong in it."""

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

    async def pixels(self, across: float = 0.5, down: float = 0.42, size: int = 48) -> list[int]:
        """What is drawn around a place, from 0 to 1: read back from the frame that is drawn next."""
        return [int(each) for each in await self.value(PIXELS, [across, down, size])]

    async def drives(self, heard: Heard, take: Act, let_go: Act) -> None:
        """Hold until the robot is told to go; anew where a busy machine let the scene stand still."""
        heard.speeds.clear()

        while not (len(heard.speeds) > 3 and heard.last):
            if not await self.state("held"):
                await let_go()
                await until(lambda: self.state("held === false && macsXr.telling.state.barred === ''"))
                await self.frame()
                await take()
            # it is told that it drives, or not: both take a moment
            for _ in range(40):
                await asyncio.sleep(0.05)
                if len(heard.speeds) > 3 and heard.last:
                    break

    async def frame(self, count: int = 2) -> None:
        """Wait until the scene has had so many frames."""
        before = await self.value("macsXr.frames")
        await until(lambda: self.value(f"macsXr.frames >= {before + count}"))

    async def shot(self, name: str) -> Path:
        """A picture of what is seen."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        path = SCREENSHOTS / f"xr-{name}.png"
        await self.value("look(true)")
        await self.frame()
        await self.page.screenshot(path=path)
        await self.value("look(false)")
        return path


async def headset_at(
    site: Site | Gate,
    settings: dict[str, Any] | None = None,
    *,
    wanted: bool = False,
    size: str = SMALL,
    rate: str = SLOWER,
) -> Headset:
    """A headset that has opened the scene, with these settings, and of this size, `UNDRAWN` for who looks at no pixel;
    ``wanted``: where a token is; ``rate``: how often it has a frame, empty for as often as the browser can."""
    context = await (await site.chromium()).new_context(viewport={"width": 640, "height": 420})
    for script in scripts(settings, size=size, rate=rate):
        await context.add_init_script(script=script)
    url = site.url if isinstance(site, Site) else site.url_of(wanted=wanted)
    watched = await opened(context, f"{url}xr")
    site.pages.append(watched)
    return Headset(watched.page, watched)


def scripts(settings: dict[str, Any] | None = None, *, size: str = SMALL, rate: str = SLOWER) -> list[str]:
    """What runs in a page before its own scripts, for a headset as `headset_at` has it."""
    kept = json.dumps(json.dumps({**PATIENT, **(settings or {})}))
    first = f"localStorage.getItem('macs.xr') ?? localStorage.setItem('macs.xr', {kept})"
    return [IWER.read_text(encoding="utf-8"), f"{{{size}}}", f"{{{rate}}}", f"{DEVICE}\n{first}"]


def by_grip(headset: Headset) -> tuple[Act, Act]:
    """How it is driven by the right controller, and let go of."""

    async def take() -> None:
        await headset.squeeze("right", held=True)
        await headset.stick("right", 0, -1)

    async def let_go() -> None:
        await headset.squeeze("right", held=False)

    return take, let_go


def about_up(radians: float) -> tuple[float, float, float, float]:
    """The quaternion of a turn to the left."""
    return 0.0, math.sin(radians / 2), 0.0, math.cos(radians / 2)


async def pause(seconds: float) -> None:
    """For what must not happen meanwhile."""
    await asyncio.sleep(seconds)


class Pictures:
    """A camera that a test can freeze: small pictures at 30 Hz on a topic of its own."""

    def __init__(self, domain: int) -> None:
        self._peer = Peer(domain, "camera")
        self._task: asyncio.Task[None] | None = None
        self._mode = "go"
        self._sent_at = 0.0
        self._kept: Any = None

    async def __aenter__(self) -> Pictures:
        publisher = await self._peer.publisher(CompressedImage, PICTURES, qos_profile_sensor_data)
        self._task = asyncio.create_task(self._run(publisher))
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        self._peer.session.close()

    def freeze(self) -> float:
        """No picture any more; when the last one was sent."""
        self._mode = "frozen"
        return self._sent_at

    def repeat(self) -> None:
        """The last picture again and again, as a driver that hangs sends it."""
        self._mode = "repeat"

    def go_on(self) -> None:
        """New pictures again."""
        self._mode = "go"

    async def _run(self, publisher: Any) -> None:
        shade = 0
        while True:
            if self._mode == "go" or self._kept is None:
                shade = (shade + 8) % 256
                self._kept = self._picture(shade)
            if self._mode != "frozen":
                await self._peer.session.run(partial(publisher.publish, self._kept))
                self._sent_at = time.monotonic()
            await asyncio.sleep(1 / 30)

    def _picture(self, shade: int) -> Any:
        message = CompressedImage()
        message.header.stamp = self._peer.session.node.get_clock().now().to_msg()
        message.format = "png"
        message.data = array.array("B", png(32, 24, shade))
        return message


def png(width: int, height: int, shade: int) -> bytes:
    """A picture of one grey, as a PNG file."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = (b"\0" + bytes([shade]) * width) * height
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows, 1)), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
