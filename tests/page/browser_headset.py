"""python browser_headset.py ws://HOST:PORT/macs [worker]: the headset of headset.js in Chromium, until SIGTERM."""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from playwright.async_api import Route

from tests.support.browser import STATIC, browser

PAGE = "http://localhost/"
"""Nobody answers there: each request is answered here."""


async def answer(route: Route) -> None:
    name = route.request.url.removeprefix(PAGE)
    if name == "":
        await route.fulfill(body="<!doctype html><title>headset</title>", content_type="text/html")
        return
    folder = Path(__file__).parent if name in ("headset.js", "worker.js") else STATIC
    await route.fulfill(path=folder / name, content_type="text/javascript")


IN_PAGE = (
    "async (url) => { window.end = (await import('/headset.js')).begin(await import('/macs.js'), url) }",
    "async () => { end(); await new Promise((done) => setTimeout(done, 300)) }",
)
IN_WORKER = (
    "(url) => { window.worker = new Worker('/worker.js', {type: 'module'}); worker.postMessage({url}) }",
    "async () => { worker.postMessage({end: true}); await new Promise((done) => setTimeout(done, 300)) }",
)


async def main(url: str, where: str = "page") -> None:
    told = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, told.set)
    begin, end = IN_WORKER if where == "worker" else IN_PAGE
    # a page that nobody served may not call this machine, else than with its user's consent
    async with browser("--disable-features=LocalNetworkAccessChecks") as chromium:
        page = await chromium.new_page()
        await page.context.route("**/*", answer)
        await page.goto(PAGE)
        await page.evaluate(begin, url)
        await told.wait()
        await page.evaluate(end)


asyncio.run(main(*sys.argv[1:]))
