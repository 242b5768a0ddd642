"""A whole site for pages: router, gateway, the demo robot and its agent as processes, and browsers.

All tests here run in one loop: a worker has one browser, in which each test has contexts of its own, and tests that
leave their site as it was share it.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import os
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Generator
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio

from bridge.tokens import store
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.page.polls import until
from tests.support.browser import Watched, another, opened
from tests.support.isolation import worker_number
from tests.support.processes import Process
from tests.support.programs import Program, free_port

if TYPE_CHECKING:
    from playwright.async_api import Browser, Playwright

ROBOT = """
[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 2.0
deadman_s = 0.5
deadman_message = {}
"""
DOMAINS = 6
"""Behind all that other tests take, which run beside a site that is shared; as many again are for second robots."""
_domains = itertools.cycle(range(221, 221 + DOMAINS))
for _ in range((os.getpid() + worker_number()) % DOMAINS):
    next(_domains)


FAILED = pytest.StashKey[bool]()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One loop for all of them."""
    for item in items:
        if item.path.parent == Path(__file__).parent and pytest_asyncio.is_async_test(item):
            item.add_marker(pytest.mark.asyncio(loop_scope="session"), append=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Remember that a test failed: who knows what it has left."""
    report = yield
    item.stash[FAILED] = item.stash.get(FAILED, False) or report.failed
    return report


Chromium = Callable[[], Awaitable["Browser"]]


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def driver() -> AsyncIterator[Playwright]:
    """What starts browsers, and speaks with them."""
    from playwright.async_api import async_playwright

    async with async_playwright() as started:
        yield started


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def chromium(driver: Playwright) -> AsyncIterator[Chromium]:
    """The browser, started once."""
    found: list[Browser] = []
    async with AsyncExitStack() as stack:

        async def get() -> Browser:
            if not found or not found[-1].is_connected():
                found.append(await stack.enter_async_context(another(driver)))
            return found[-1]

        yield get


@dataclass
class Gate:
    """Gateways without a robot: the second one wants a token."""

    chromium: Chromium
    ports: tuple[int, int]
    secret: str
    pages: list[Watched] = field(default_factory=list)

    def url_of(self, *, wanted: bool) -> str:
        """Of the gateway that wants a token, or of the other one."""
        return f"http://127.0.0.1:{self.ports[int(wanted)]}/"


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
    chromium: Chromium
    pages: list[Watched] = field(default_factory=list)

    @property
    def url(self) -> str:
        """Of the page."""
        return f"http://127.0.0.1:{self.web_port}/"

    async def open(self, path: str = "", *, script: str = "", **options: Any) -> Watched:
        """A page in a browser of its own, so far as cache and cookies go, that runs a script before its own."""
        options = {"viewport": {"width": 1280, "height": 900}, "color_scheme": "dark", **options}
        context = await (await self.chromium()).new_context(**options)
        await context.add_init_script(script=f"{{{script}}}")
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


async def started(
    stack: AsyncExitStack,
    folder: Path,
    chromium: Chromium,
    gateway: tuple[str, ...] = (),
    rules: str = ROBOT,
    agent: tuple[str, ...] = (),
    *,
    router: bool = True,
) -> Site:
    """A site; ``gateway`` and ``agent`` are words for these. Without a ``router`` of its own the gateway is one."""
    domain = next(_domains)
    environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    endpoint, web_port = f"tcp/127.0.0.1:{free_port()}", free_port()
    settings = folder / f"robot-{domain}.toml"
    settings.write_text(rules)
    joins = ("-e", endpoint) if router else ("--mode", "router", "-l", endpoint)
    words = ["--port", str(free_port()), "--web-port", str(web_port), *joins, *gateway]
    own = await stack.enter_async_context(Program("router", "-l", endpoint)) if router else None
    started_gateway = await stack.enter_async_context(Program("gateway", *words))
    robot = ["--id", "1", "--settings", str(settings), "-e", endpoint, *agent]
    return Site(
        own or started_gateway,
        started_gateway,
        await stack.enter_async_context(Program("agent", *robot, env=environment)),
        await stack.enter_async_context(Process(sys.executable, "-m", "bridge.cli.demo_robot", env=environment)),
        web_port,
        domain,
        endpoint,
        chromium,
    )


async def judged(pages: list[Watched]) -> None:
    """Judge these pages, and close them."""
    from playwright.async_api import Error

    try:
        for page in pages:
            page.judge()
    finally:
        for page in pages:
            with suppress(Error):  # it is closed
                await page.page.context.close()


@pytest_asyncio.fixture(loop_scope="session")
async def start_site(tmp_path: Path, chromium: Chromium) -> AsyncIterator[StartSite]:
    """Starts sites of the test's own, as `started` has it."""
    async with AsyncExitStack() as stack:
        sites: list[Site] = []

        async def start(gateway: tuple[str, ...] = (), **options: Any) -> Site:
            sites.append(await started(stack, tmp_path, chromium, gateway, **options))
            return sites[-1]

        yield start
        await judged([page for site in sites for page in site.pages])


@dataclass
class Shared:
    """The site that tests share, started anew after one that failed, and for those of a module with other rules."""

    folder: Path
    chromium: Chromium
    rules: str = ""
    stack: AsyncExitStack = field(default_factory=AsyncExitStack)
    site: Site | None = None

    async def get(self, rules: str) -> Site:
        if self.site is None or self.rules != rules:
            await self.stop()
            self.site, self.rules = await started(self.stack, self.folder, self.chromium, rules=rules), rules
        return replace(self.site, pages=[])

    async def stop(self) -> None:
        self.site = None
        await self.stack.aclose()


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def shared(tmp_path_factory: pytest.TempPathFactory, chromium: Chromium) -> AsyncIterator[Shared]:
    found = Shared(tmp_path_factory.mktemp("site"), chromium)
    yield found
    await found.stop()


@pytest_asyncio.fixture(loop_scope="session")
async def site(shared: Shared, request: pytest.FixtureRequest) -> AsyncIterator[Site]:
    """One that each test leaves as it was: all runs, and nothing is stopped. Its robot has the module's ``RULES``."""
    site = await shared.get(getattr(request.module, "RULES", ROBOT))
    yield site
    good = False
    try:
        await judged(site.pages)
        good = not request.node.stash.get(FAILED, False)
    finally:
        if not good:
            await shared.stop()


@pytest_asyncio.fixture(scope="session", loop_scope="session")
async def gateways(
    tmp_path_factory: pytest.TempPathFactory, chromium: Chromium, shared: Shared
) -> AsyncIterator[Gate]:
    await shared.stop()  # its robot publishes all the time
    secret, words = with_token(tmp_path_factory.mktemp("gate") / "tokens.json", Rights(may=["see"], robots="any"))
    async with AsyncExitStack() as stack:
        endpoint, ports = f"tcp/127.0.0.1:{free_port()}", (free_port(), free_port())
        await stack.enter_async_context(Program("router", "-l", endpoint))
        for port, more in zip(ports, ((), words), strict=True):
            argv = ["--port", str(free_port()), "--web-port", str(port), "-e", endpoint, *more]
            await stack.enter_async_context(Program("gateway", *argv))
        yield Gate(chromium, ports, secret)


@pytest_asyncio.fixture(loop_scope="session")
async def gate(gateways: Gate) -> AsyncIterator[Gate]:
    """The gateways, which tests share."""
    gate = replace(gateways, pages=[])
    yield gate
    await judged(gate.pages)


async def signed_in(site: Site, secret: str) -> Watched:
    """A page that has shown a token."""
    page = await site.open()
    await page.page.fill("#token", secret)
    await page.page.click("button[type=submit]")
    await page.page.wait_for_selector("header.top", timeout=60_000)
    return page


def with_token(path: Path, rights: Rights, name: str = "hall") -> tuple[str, tuple[str, ...]]:
    """A token with these rights in a file: its secret, and the words for a gateway that wants one."""
    secret = new_secret(os.urandom(32))
    token = Token(name=name, rights=rights, hashes=[hash_of(secret)])
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    return secret, ("--tokens", str(path), "--without-token", "nobody")


async def released(page: Watched) -> None:
    """Press release, twice within three seconds as it wants it, and again where a busy machine took longer; nothing is
    stopped then."""
    nothing = partial(page.value, "document.querySelector('#stop-status').textContent === ''")
    for _ in range(5):
        await page.page.click("#release")
        await page.page.click("#release")
        with suppress(AssertionError):
            await until(nothing, 10)
            return
    await until(nothing)


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
