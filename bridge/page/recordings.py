"""What a gateway's web port passes on between its visitors and the recorder of this machine.

The recorder is a process of its own that is asked by a socket in its folder (`bridge.recording.serving`). Here it is
asked who may; no file is read or written here, and a download takes no more of the gateway than its rate.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from urllib.parse import quote

import aiohttp
import msgspec
from aiohttp import web

from bridge.audit import who
from bridge.gateway.site import Site
from bridge.recording.serving import socket_of
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.attempts import Attempts
from macs_zenoh.protocol.rights import Grant

log = logging.getLogger("macs.gateway")

ANSWER_BYTES = 8 << 20
ANSWER_S = 30.0
SILENT_S = 15.0
"""A download in which nothing comes from the recorder for so long is ended."""
DOWNLOADS = 4
DOWNLOAD_BYTES_PER_S = 24e6
"""Of all downloads together: headsets come first."""
PIECE_BYTES = 64 << 10
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,199}\.mcap", re.ASCII)
MISSING = "this token does not give the right to record"


class _Said(msgspec.Struct):
    """An answer that is none."""

    error: str


class Recordings:
    """The way to one recorder."""

    def __init__(self, site: Site, folder: Path) -> None:
        self._site = site
        self._socket = socket_of(folder)
        self._session: aiohttp.ClientSession | None = None
        self._not_done = Attempts()
        """What was asked for and not done, by who asked and for what."""
        self._downloads = 0
        self._next_s = 0.0
        """When the next piece of a download may go."""

    def add_to(self, site: Site) -> None:
        """Say what is where."""
        site.get("/recordings/state", self._state)
        site.get("/recordings/happened/{name}", self._happened)
        site.get("/recordings/files/{name}", self._download)
        site.post("/recordings/{what:start|stop|ring|replay|replay-stop}", self._ordered)
        site.on_close(self.close)

    def close(self) -> None:
        """Ask nothing more."""
        if self._session is not None:
            closing = asyncio.ensure_future(self._session.close())
            closing.add_done_callback(lambda _: None)
            self._session = None

    async def _state(self, _: web.Request, visitor: Grant) -> web.StreamResponse:
        if not may_record(visitor):
            return _refused()
        answer = await self._ask("GET", "/state")
        if answer.status != 200:
            answer.set_status(200)  # that there is no recorder is a state as well
        return answer

    async def _happened(self, request: web.Request, visitor: Grant) -> web.StreamResponse:
        if not may_record(visitor):
            return _refused()
        name = _name(request)
        return _no_file() if name is None else await self._ask("GET", f"/happened/{name}")

    async def _ordered(self, request: web.Request, visitor: Grant) -> web.StreamResponse:
        what = request.match_info["what"]
        by = who(address=self._site.host_of(request), token=visitor.name)
        if not may_record(visitor):
            self._note_refused(by, what, MISSING)
            return _refused()
        body = await request.read()
        self._site.goes_on(request)
        answer = await self._ask("POST", f"/{what}", body, request)
        if answer.status == 200:
            self._site.gateway.keep_record("recording", by, what)
        else:
            self._note_refused(by, what, _problem(answer))
        log.info("%s asked the recorder to %s: %s", visitor.name or self._site.host_of(request), what, answer.status)
        return answer

    def _note_refused(self, by: dict[str, str], what: str, why: str) -> None:
        """At once, and then once in a while with how often: or who asks all day would push what was done out of the
        record."""
        count = self._not_done.note(f"{by.get('token') or by.get('address')} {what}", time.monotonic())
        if count:
            told = "" if count == 1 else f" ({count} times by now)"
            self._site.gateway.keep_record("recording", by, what, why + told)

    async def _ask(
        self, method: str, path: str, body: bytes = b"", request: web.Request | None = None
    ) -> web.Response:
        """The recorder's answer, or why there is none."""
        try:
            async with (
                self._going_on(request),
                self._client().request(method, f"http://recorder{path}", data=body) as found,
            ):
                answer = bytearray()
                async for piece in found.content.iter_any():
                    answer += piece
                    if len(answer) > ANSWER_BYTES:
                        return _no_answer("the recorder tells too much")
                return web.Response(body=bytes(answer), status=found.status, content_type="application/json")
        except (aiohttp.ClientError, asyncio.TimeoutError, OSError) as error:
            status = 504 if isinstance(error, asyncio.TimeoutError) else 502
            return _no_answer(f"the recorder does not answer: {_why(error)}", status)

    @asynccontextmanager
    async def _going_on(self, request: web.Request | None) -> AsyncIterator[None]:
        """Give an answer time that the recorder takes long for."""

        async def again(request: web.Request) -> None:
            while True:
                self._site.goes_on(request)
                await asyncio.sleep(1.0)

        task = None if request is None else asyncio.ensure_future(again(request))
        try:
            yield
        finally:
            if task is not None:
                task.cancel()

    async def _download(self, request: web.Request, visitor: Grant) -> web.StreamResponse:
        if not may_record(visitor):
            return _refused()
        name = _name(request)
        if name is None:
            return _no_file()
        if self._downloads >= DOWNLOADS:
            error = {"error": f"{DOWNLOADS} downloads go on already"}
            return web.json_response(error, status=503, headers={"Retry-After": "10"})
        by = who(address=self._site.host_of(request), token=visitor.name)
        self._site.gateway.keep_record("recording", by, f"download {name}")
        self._downloads += 1
        try:
            return await self._passed_on(request, name)
        finally:
            self._downloads -= 1

    async def _passed_on(self, request: web.Request, name: str) -> web.StreamResponse:
        headers = {key: request.headers[key] for key in ("Range", "If-Range") if key in request.headers}
        timeout = aiohttp.ClientTimeout(total=None, sock_read=SILENT_S)
        response: web.StreamResponse | None = None
        try:
            address = f"http://recorder/files/{name}"
            async with self._client().get(address, headers=headers, timeout=timeout) as found:
                if found.status not in (200, 206):
                    return _no_file() if found.status == 404 else web.Response(status=found.status)
                told = {k: found.headers[k] for k in ("Content-Length", "Content-Range", "ETag") if k in found.headers}
                told |= {"Accept-Ranges": "bytes", "Content-Type": "application/octet-stream"}
                told |= {"Content-Disposition": f'attachment; filename="{name}"', "Cache-Control": "no-store"}
                response = web.StreamResponse(
                    status=found.status, headers={**told, "X-Content-Type-Options": "nosniff"}
                )
                await response.prepare(request)
                async for piece in found.content.iter_chunked(PIECE_BYTES):
                    self._site.goes_on(request)
                    await self._turn(len(piece))
                    await response.write(piece)
                await response.write_eof()
                return response
        except (aiohttp.ClientError, asyncio.TimeoutError, OSError) as error:
            if response is None:
                return web.json_response({"error": f"the recorder does not answer: {_why(error)}"}, status=503)
            if request.transport is not None:
                request.transport.abort()  # who downloads must not take it for the whole
            return response

    async def _turn(self, size: int) -> None:
        """Wait until so much may go."""
        now = time.monotonic()
        self._next_s = max(self._next_s, now - 0.05) + size / DOWNLOAD_BYTES_PER_S
        await asyncio.sleep(max(0.0, self._next_s - now))

    def _client(self) -> aiohttp.ClientSession:
        if self._session is None:
            self._session = aiohttp.ClientSession(
                connector=aiohttp.UnixConnector(str(self._socket), limit=16),
                timeout=aiohttp.ClientTimeout(total=ANSWER_S),
                auto_decompress=False,
                cookie_jar=aiohttp.DummyCookieJar(),
            )
        return self._session


def may_record(visitor: Grant) -> bool:
    """Whether a visitor has the right."""
    return visitor.rights is None or visitor.rights.has("record")


def _name(request: web.Request) -> str | None:
    name = request.match_info["name"]
    return quote(name) if NAME.fullmatch(name) is not None else None


def _why(error: BaseException) -> str:
    if isinstance(error, asyncio.TimeoutError):
        return "it takes too long"
    return "is `macs record --serve` running?" if isinstance(error, OSError) else type(error).__name__


def _no_answer(why: str, status: int = 502) -> web.Response:
    return web.json_response({"error": why}, status=status)


def _problem(answer: web.Response) -> str:
    """Why something was not done, as the recorder says."""
    try:
        return msgspec.json.decode(answer.text or "", type=_Said).error
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return answer.reason or "refused"


def _refused() -> web.Response:
    return web.json_response({"error": MISSING}, status=403)


def _no_file() -> web.Response:
    return web.json_response({"error": "there is no such recording"}, status=404)


def add_recordings(site: Site) -> None:
    """Add them to a gateway's web port, where its settings name a recorder's folder."""
    folder = site.gateway.settings.recordings
    if folder is None:
        return
    try:
        Recordings(site, Path(folder)).add_to(site)
    except ConfigError as error:
        raise ConfigError("gateway.recordings", str(error)) from error
