"""How a page's pad is taken hold of, and what its robot is told then."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import Twist

from tests.page.conftest import HELD, Act, Site
from tests.page.polls import until
from tests.support.browser import Watched
from tests.support.ros_peer import Peer


async def hold(page: Watched, across: float = 0.0, up: float = 0.8) -> None:
    """Press on the pad and drag there: from -1 to 1."""
    box = await page.page.locator("#pad").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.page.mouse.move(x, y)
    await page.page.mouse.down()
    await page.page.mouse.move(x + across * 0.38 * box["width"], y - up * 0.38 * box["height"], steps=3)


@contextlib.asynccontextmanager
async def held(page: Watched) -> AsyncIterator[None]:
    """It is held all the while, anew where a busy machine lets the page stand still."""

    async def hold_on() -> None:
        while True:
            if not await page.value(HELD):
                await page.page.mouse.up()
                await hold(page)
            await asyncio.sleep(0.05)

    holding = asyncio.create_task(hold_on())
    try:
        yield
    finally:
        holding.cancel()
        await asyncio.gather(holding, return_exceptions=True)
        await page.page.mouse.up()


def pointer(page: Watched, across: float = 0.0, up: float = 0.8) -> tuple[Act, Act]:
    """How it is taken hold of by the pointer, and let go."""
    return partial(hold, page, across, up), page.page.mouse.up


def key(page: Watched, name: str) -> tuple[Act, Act]:
    """The same by a key."""
    return partial(page.page.keyboard.down, name), partial(page.page.keyboard.up, name)


class Heard:
    """Commands that the robot gets, as a ROS node beside it hears them."""

    def __init__(self) -> None:
        self.speeds: list[float] = []
        self.stopped_at = 0.0
        """When the first zero after another command came."""

    async def listen(self, peer: Peer) -> None:
        def take(twist: Any) -> None:
            if twist.linear.x == 0 and self.last:
                self.stopped_at = time.monotonic()
            self.speeds.append(twist.linear.x)

        await peer.session.run(lambda: peer.session.node.create_subscription(Twist, "/cmd_vel", take, 1000))

    @property
    def last(self) -> float | None:
        return self.speeds[-1] if self.speeds else None


@contextlib.asynccontextmanager
async def heard_at(site: Site) -> AsyncIterator[Heard]:
    """What the robot of a site is told."""
    peer, heard = Peer(site.domain), Heard()
    try:
        await heard.listen(peer)
        yield heard
    finally:
        peer.session.close()


TRIES = 6


async def within(limit_ms: float, measure: Callable[[], Awaitable[float]]) -> list[float]:
    """Measure until it is soon enough once; fail if it never is."""
    took: list[float] = []
    while len(took) < TRIES and (not took or took[-1] > limit_ms):
        took.append(await measure())
    assert took[-1] <= limit_ms, f"at most {limit_ms:.0f} ms are wanted: {', '.join(f'{ms:.0f}' for ms in took)}"
    return took


GAMEPADS = """
const gamepad = (pressed) => ({connected: true, index: 0, axes: [0, -1], buttons: [{}, {}, {}, {}, {}, {pressed}]});
const have = (...pads) => { navigator.getGamepads = () => pads };
const seen = () => new Promise((done) => setTimeout(() => requestAnimationFrame(done), 150));
"""
GAMEPAD_HELD = f"(() => {{ {GAMEPADS} have(gamepad(true)) }})()"
"""Its shoulder button held, its stick pushed forward."""
GAMEPAD = f"(async () => {{ {GAMEPADS} have(gamepad(false)); await seen(); have(gamepad(true)); await seen() }})()"
"""The same, after it was seen with its button released."""


def face_buttons(*, a: bool, b: bool) -> str:
    """A gamepad with these buttons pressed, and no other."""
    pressed = f"[one.buttons[0].pressed, one.buttons[1].pressed] = [{str(a).lower()}, {str(b).lower()}]"
    return f"(async () => {{ {GAMEPADS} const one = gamepad(false); {pressed}; have(one); await seen() }})()"


NO_GAMEPAD = f"(async () => {{ {GAMEPADS} have(); await seen() }})()"


async def drives(page: Watched, heard: Heard) -> None:
    """Take hold until the robot is told to go."""
    heard.speeds.clear()

    async def told() -> bool:
        if not await page.value(HELD):
            await page.page.mouse.up()
            await hold(page)
        return len(heard.speeds) > 5 and (heard.last or 0.0) > 0

    await until(told, every_s=0.05)
