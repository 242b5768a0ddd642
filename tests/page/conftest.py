"""A whole site for pages: router, gateway, the demo robot and its agent as processes, and browsers."""

from __future__ import annotations

import asyncio
import itertools
import math
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.browser import Watched, browser, opened
from tests.support.isolation import worker_number
from tests.support.processes import Process
from tests.support.programs import Program, free_port
from tests.support.waiting import until

if TYPE_CHECKING:
    from playwright.async_api import Browser

ROBOT = """
[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 2.0
deadman_s = 0.5
deadman_message = {}
"""
DOMAINS = 20
_domains = itertools.cycle(range(80, 80 + DOMAINS))
for _ in range((os.getpid() + worker_number() * 7) % DOMAINS):
    next(_domains)


@dataclass
class Site:
    """What runs, each program by itself so that it can be killed and started again."""

    router: Program
    gateway: Program
    agent: Program
    demo: Process
    web_port: int
    domain: int
    endpoint: str
    browser: Browser
    pages: list[Watched] = field(default_factory=list)

    @property
    def url(self) -> str:
        """Of the page."""
        return f"http://127.0.0.1:{self.web_port}/"

    async def open(self, path: str = "", **options: Any) -> Watched:
        """A page in a browser of its own, so far as cache and cookies go."""
        options = {"viewport": {"width": 1280, "height": 900}, "color_scheme": "dark", **options}
        context = await self.browser.new_context(**options)
        page = await opened(context, self.url + path)
        self.pages.append(page)
        return page

    async def with_robot(self, **options: Any) -> Watched:
        """A page that shows the demo robot: its picture, its place, its pad."""
        page = await self.open(**options)
        await page.page.wait_for_selector("#camera--camera-image-compressed canvas[data-shown]", timeout=60_000)
        await page.page.wait_for_selector("#trail canvas[data-x]", timeout=60_000)
        await page.page.wait_for_selector('#pad[aria-disabled="false"]', timeout=60_000)
        return page


Act = Callable[[], Awaitable[object]]
StartSite = Callable[..., Awaitable[Site]]


@pytest.fixture
async def start_site(tmp_path: Path) -> AsyncIterator[StartSite]:
    """Starts a site; ``gateway`` and ``agent`` are words for these."""
    async with AsyncExitStack() as stack:
        sites: list[Site] = []

        async def start(gateway: tuple[str, ...] = (), rules: str = ROBOT, agent: tuple[str, ...] = ()) -> Site:
            domain = next(_domains)
            environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
            endpoint, web_port = f"tcp/127.0.0.1:{free_port()}", free_port()
            settings = tmp_path / f"robot-{domain}.toml"
            settings.write_text(rules)
            words = ["--port", str(free_port()), "--web-port", str(web_port), "-e", endpoint, *gateway]
            robot = ["--id", "1", "--settings", str(settings), "-e", endpoint, *agent]
            site = Site(
                await stack.enter_async_context(Program("router", "-l", endpoint)),
                await stack.enter_async_context(Program("gateway", *words)),
                await stack.enter_async_context(Program("agent", *robot, env=environment)),
                await stack.enter_async_context(
                    Process(sys.executable, "-m", "bridge.cli.demo_robot", env=environment)
                ),
                web_port,
                domain,
                endpoint,
                await stack.enter_async_context(browser()),
            )
            sites.append(site)
            return site

        yield start
        for page in (page for site in sites for page in site.pages):
            page.judge()


@pytest.fixture
async def site(start_site: StartSite) -> Site:
    """One with its usual settings."""
    return await start_site()


async def signed_in(site: Site, secret: str) -> Watched:
    """A page that has shown a token."""
    page = await site.open()
    await page.page.fill("#token", secret)
    await page.page.click("button[type=submit]")
    await page.page.wait_for_selector("header.top", timeout=60_000)
    return page


def with_token(path: Path, rights: Rights) -> tuple[str, tuple[str, ...]]:
    """A token with these rights in a file: its secret, and the words for a gateway that wants one."""
    secret = new_secret(os.urandom(32))
    token = Token(name="hall", rights=rights, hashes=[hash_of(secret)])
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    return secret, ("--tokens", str(path), "--without-token", "nobody")


async def says(page: Watched, selector: str, words: str) -> bool:
    """Whether an element has these words."""
    return words in await page.page.inner_text(selector)


HELD = "document.querySelector('#pad').classList.contains('held')"


async def driven(page: Watched, take: Act, let_go: Act, metres: float = 0.1, turn: float = 0.0) -> None:
    """Drive until the page shows the robot so far from where it was, and turned by so many radians. Where a busy
    machine lets the page stand still it lets go, as it should; then it is taken hold of anew."""
    place, heading = await where(page), await heading_of(page)
    await take()

    async def far() -> bool:
        if not await page.value(HELD):
            await let_go()
            await take()
        x, y = await where(page)
        turned = abs(math.remainder(await heading_of(page) - heading, math.tau))
        return math.dist((x, y), place) >= metres and turned >= turn

    await until(far, every_s=0.05)


async def heading_of(page: Watched) -> float:
    """Where the page shows the robot to look, in radians."""
    return float(await page.value("document.querySelector('#trail canvas').dataset.heading"))


async def where(page: Watched) -> tuple[float, float]:
    """Where the page shows the robot."""
    x, y = await page.value("(({ x, y }) => [Number(x), Number(y)])(document.querySelector('#trail canvas').dataset)")
    return x, y


async def still(page: Watched) -> tuple[float, float]:
    """Wait until the robot stands; where."""
    before = await where(page)
    for _ in range(200):
        await asyncio.sleep(0.25)
        now = await where(page)
        if now == before:
            return now
        before = now
    raise AssertionError("the robot does not stand still")
