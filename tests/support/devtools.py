"""A Chromium that is spoken to by DevTools, and left alone in between: for what says how long something takes.

Playwright has each message of a WebSocket told to it as JSON, and nothing turns that off: 0.9 MB are 1.2 MB then, and
half a core goes there, as at no headset. Here nobody is told of the network, and while nothing is asked nobody is at
the page at all.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse

from tests.support.browser import ARGUMENTS, chromium
from tests.support.processes import Process

AT = re.compile(r"DevTools listening on (ws://\S+)")
AWAKE = (
    *("--headless", "--disable-background-timer-throttling", "--disable-renderer-backgrounding"),
    *("--disable-backgrounding-occluded-windows", "--hide-scrollbars", "--mute-audio"),
)
"""As Playwright has it, where it concerns how a page runs."""
PROBLEMS = """
window.problems = [];
addEventListener('error', ({ message }) => problems.push(message));
addEventListener('unhandledrejection', ({ reason }) => problems.push(String(reason)));
"""


class Devtools:
    """What a browser is asked, and says."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self._socket = socket
        self._numbers = itertools.count(1)
        self._open: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._traced: list[dict[str, Any]] = []
        self._trace_is_told = asyncio.Event()
        self._reading = asyncio.create_task(self._read())

    async def ask(self, method: str, *, session: str | None = None, **parameters: Any) -> dict[str, Any]:
        """What a command gives. Raises RuntimeError with what the browser says of it, or of its end."""
        number = next(self._numbers)
        answer = self._open[number] = asyncio.get_running_loop().create_future()
        said = {"id": number, "method": method, "params": parameters}
        await self._socket.send_json(said if session is None else {**said, "sessionId": session})
        return await answer

    async def trace(self, categories: list[str], seconds: float) -> list[dict[str, Any]]:
        """What the browser notes of itself meanwhile. It is told afterwards."""
        self._traced.clear()
        self._trace_is_told.clear()
        await self.ask("Tracing.start", transferMode="ReportEvents", categories=",".join(categories))
        await asyncio.sleep(seconds)
        await self.ask("Tracing.end")
        await self._trace_is_told.wait()
        return list(self._traced)

    async def close(self) -> None:
        """End the browser: a signal may end only what has started it."""
        with suppress(RuntimeError):
            await self.ask("Browser.close")
        await self._reading

    async def _read(self) -> None:
        async for message in self._socket:
            said = json.loads(message.data)
            if said.get("method") == "Tracing.dataCollected":
                self._traced += said["params"]["value"]
            elif said.get("method") == "Tracing.tracingComplete":
                self._trace_is_told.set()
            elif (answer := self._open.pop(said.get("id"), None)) is not None and not answer.done():
                if "error" in said:
                    answer.set_exception(RuntimeError(said["error"]["message"]))
                else:
                    answer.set_result(said["result"])
        for answer in self._open.values():
            if not answer.done():
                answer.set_exception(RuntimeError("the browser has ended"))
        self._trace_is_told.set()


class LonePage:
    """A page that nobody watches, but while it is asked something."""

    def __init__(self, devtools: Devtools, target: str) -> None:
        self.devtools = devtools
        self._target = target
        self._kept: str | None = None
        """The session of who stays."""

    @asynccontextmanager
    async def watched(self) -> AsyncIterator[None]:
        """For many questions: meanwhile it has the focus, and somebody stays at it."""
        async with self._session() as session:
            self._kept = session
            try:
                await self._ask("Emulation.setFocusEmulationEnabled", enabled=True)
                yield
            finally:
                self._kept = None

    async def open(self, url: str, *scripts: str) -> None:
        """Go there, after scripts of ours have run in it. Within `watched`."""
        await self._ask("Page.enable")  # without it no script is run before those of the page
        for script in (PROBLEMS, *scripts):
            await self._ask("Page.addScriptToEvaluateOnNewDocument", source=f"{{{script}}}")
        await self._ask("Page.navigate", url=url)

    async def evaluate(self, script: str, argument: Any = None) -> Any:
        """What JavaScript gives, an expression or a function of the argument."""
        call = f"typeof given === 'function' ? given({json.dumps(argument)}) : given"
        expression = f"(async () => {{ const given = ({script}\n); return {call} }})()"
        options = {"returnByValue": True, "awaitPromise": True, "userGesture": True}
        given = await self._ask("Runtime.evaluate", expression=expression, **options)
        if "exceptionDetails" in given:
            details = given["exceptionDetails"]
            raise RuntimeError(details.get("exception", {}).get("description", details["text"]))
        return given["result"].get("value")

    async def click(self, selector: str) -> None:
        """Press what is there."""
        await self.evaluate("(selector) => document.querySelector(selector).click()", selector)

    async def _ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        if self._kept is not None:
            return await self.devtools.ask(method, session=self._kept, **parameters)
        async with self._session() as session:
            return await self.devtools.ask(method, session=session, **parameters)

    @asynccontextmanager
    async def _session(self) -> AsyncIterator[str]:
        session = (await self.devtools.ask("Target.attachToTarget", targetId=self._target, flatten=True))["sessionId"]
        try:
            yield session
        finally:
            await self.devtools.ask("Target.detachFromTarget", sessionId=session)


class Lone(Process):
    """A browser by itself."""

    url = ""

    def _end(self, number: signal.Signals) -> None:
        """It is told by DevTools."""

    def _heard(self, line: str, *, is_log: bool) -> bool:
        if is_log and (found := AT.search(line)):
            self.url = found[1]
        return bool(self.url)


@asynccontextmanager
async def lone_page(folder: Path, *, width: int = 640, height: int = 420) -> AsyncIterator[LonePage]:
    """A page of a Chromium that keeps what it keeps in this folder."""
    found = chromium()
    assert found is not None
    words = (*ARGUMENTS, *AWAKE, "--remote-debugging-port=0", f"--user-data-dir={folder}", "about:blank")
    async with AsyncExitStack() as stack:
        browser = await stack.enter_async_context(Lone(found, *words))
        client = await stack.enter_async_context(ClientSession())
        devtools = Devtools(await client.ws_connect(browser.url, max_msg_size=0))
        stack.push_async_callback(devtools.close)
        made = await devtools.ask("Target.createTarget", url="about:blank", width=width, height=height)
        yield LonePage(devtools, made["targetId"])
