"""Answers what is asked of recordings, on a socket in their folder: HTTP, with JSON. Asyncio.

Whoever can open the socket may do all of it; a gateway, which can, asks its visitors for the right to ``record``.
"""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import signal
import socket
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeGuard, TypeVar

import msgspec
from aiohttp import web
from msgspec import Meta, Struct

from bridge.recording.room import FULL, LEAST
from bridge.recording.serving import socket_of
from bridge.recording.serving.children import Child
from bridge.recording.serving.folder import Folder
from macs_zenoh.errors import ConfigError, MacsError, Refused, UsageError
from macs_zenoh.protocol.name_patterns import NamePattern

log = logging.getLogger("macs.record")

BODY_BYTES = 4 << 10
PLAYED_S = 1800.0
"""A replay goes on, again and again from where it began, until it is stopped, and no longer than this."""
RING_AGAIN_S = 5.0
READING = 2
"""So many files are gone through at a time for who asks what happened in them."""

Robot = Annotated[int, Meta(ge=1, le=0xFFFF)]


class Start(Struct, frozen=True, forbid_unknown_fields=True):
    """What to record: all robots and topics unless some are named."""

    robots: Annotated[list[Robot], Meta(max_length=64)] = []
    topics: Annotated[list[NamePattern], Meta(max_length=64)] = []
    commands: bool = False
    seconds: Annotated[float, Meta(ge=0, le=86400)] = 0.0
    """0: until it is stopped."""


class Replay(Struct, frozen=True, forbid_unknown_fields=True):
    """What to play, and from where."""

    name: str
    start_s: Annotated[float, Meta(ge=0, le=1e9)] = 0.0


class Nothing(Struct, frozen=True, forbid_unknown_fields=True):
    """There is nothing to say."""


Said = TypeVar("Said")


@dataclass(frozen=True)
class Service:
    """What a recorder does.

    Attributes:
        folder: where its files are.
        mesh: words for programs that join the mesh.
        what: words for each recording.
        ring: words for the ring; none: there is none.
        most_bytes: of all files together.
        first_replay: the id of the first robot that is played; others follow it.
    """

    folder: Path
    mesh: Sequence[str] = ()
    what: Sequence[str] = ()
    ring: Sequence[str] = ()
    most_bytes: int = 50 << 30
    first_replay: int = 65001


class Recorder:
    """One recorder, from `open` to `close`."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._folder = Folder(service.folder)
        self._recording: Child | None = None
        self._file = ""
        self._ring: Child | None = None
        self._replay: Child | None = None
        self._replayed: dict[str, Any] = {}
        self._problems: dict[str, str] = {}
        """Of the recording, the ring and the replay: why it ended, until it is begun again."""
        self._ring_gone = asyncio.Event()
        self._ring_keeper: asyncio.Task[None] | None = None
        self._turn, self._ring_turn = asyncio.Lock(), asyncio.Lock()
        self._reading = asyncio.Semaphore(READING)
        self._closing = False
        self._runner: web.AppRunner | None = None

    async def open(self) -> None:
        """Serve. Raises ConfigError, UsageError: another one does so; Refused: the ring does not begin."""
        path = socket_of(self._service.folder)
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            _take_over(path)
            app = web.Application(client_max_size=BODY_BYTES)
            app.router.add_get("/state", self._answered(Nothing, self._state))
            app.router.add_post("/start", self._answered(Start, self._start))
            app.router.add_post("/stop", self._answered(Nothing, self._stop))
            app.router.add_post("/ring", self._answered(Nothing, self._write_ring))
            app.router.add_post("/replay", self._answered(Replay, self._play))
            app.router.add_post("/replay-stop", self._answered(Nothing, self._stop_playing))
            app.router.add_get("/happened/{name}", self._happened)
            app.router.add_get("/files/{name}", self._file_of)
            self._runner = web.AppRunner(app, handle_signals=False, access_log=None, shutdown_timeout=0.5)
            await self._runner.setup()
            before = os.umask(0o177)
            try:
                await web.UnixSite(self._runner, str(path)).start()
            finally:
                os.umask(before)
        except OSError as error:
            raise ConfigError(str(path), error.strerror or str(error)) from error
        if self._service.ring:
            await self._begin_ring()
            self._ring_keeper = asyncio.create_task(self._keep_ring())

    async def close(self) -> None:
        """End, with all that waits written."""
        self._closing = True
        if self._ring_keeper is not None:
            self._ring_keeper.cancel()
        children = [child for child in (self._recording, self._ring, self._replay) if child is not None]
        await asyncio.gather(*(child.stop() for child in children))
        if self._runner is not None:
            await self._runner.cleanup()
            socket_of(self._service.folder).unlink(missing_ok=True)

    # -- answers -------------------------------------------------------------------------------------------------

    def _answered(
        self, kind: type[Said], answer: Callable[[Said], Awaitable[dict[str, Any]]]
    ) -> Callable[[web.Request], Awaitable[web.Response]]:
        async def answered(request: web.Request) -> web.Response:
            try:
                said = msgspec.json.decode(await request.read() or b"{}", type=kind)
                return _json(await answer(said))
            except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
                return _json({"error": f"that makes no sense: {error}"}, 400)
            except Refused as refusal:
                return _json({"error": refusal.reason}, 409)
            except MacsError as error:
                return _json({"error": str(error)}, 409)

        return answered

    async def _state(self, _: Nothing) -> dict[str, Any]:
        being_written = {self._file} if self._recording is not None else set()
        files = await asyncio.to_thread(self._folder.listed, being_written)
        free = await asyncio.to_thread(shutil.disk_usage, self._folder.path)
        return {
            "recording": {"name": self._file, **self._recording.progress} if _is_ready(self._recording) else None,
            "ring": self._ring.progress if _is_ready(self._ring) else None,
            "replay": self._replayed if _is_ready(self._replay) else None,
            "problem": "; ".join(self._problems.values()),
            "files": files,
            "bytes": await asyncio.to_thread(lambda: self._folder.bytes),
            "most_bytes": self._service.most_bytes,
            "free_bytes": free.free,
        }

    async def _start(self, said: Start) -> dict[str, Any]:
        async with self._turn:
            if self._recording is not None:
                raise Refused(f"{self._file} is being recorded already")
            if self._service.most_bytes - await asyncio.to_thread(lambda: self._folder.bytes) < LEAST:
                raise Refused(f"{FULL}; take some files away")
            path = await asyncio.to_thread(self._folder.new)
            words = [*self._service.what]
            words += [word for robot in said.robots for word in ("--robot", str(robot))]
            words += [word for topic in said.topics for word in ("--topics", topic)]
            words += ["--commands"] if said.commands and "--commands" not in words else []
            words += ["--max-duration", f"{said.seconds}s"] if said.seconds else []
            self._problems.pop("recording", None)
            self._file = path.name
            self._recording = recording = await self._record(words, path)
            await recording.ready()
            if problem := self._problems.get("recording"):  # it has ended since
                raise Refused(problem)
            return {"name": path.name}

    async def _stop(self, _: Nothing) -> dict[str, Any]:
        async with self._turn:
            if self._recording is None:
                raise Refused("nothing is being recorded")
            await self._recording.stop()
            return {"name": self._file}

    async def _write_ring(self, _: Nothing) -> dict[str, Any]:
        if self._ring is None:
            raise Refused("this recorder has no ring: it is begun with --ring 60s")
        async with self._ring_turn:
            return {"name": (await self._ring.ask_for_ring())["file"]}

    async def _play(self, said: Replay) -> dict[str, Any]:
        async with self._turn:
            robots = await asyncio.to_thread(self._folder.robots, said.name)
            if not robots:
                raise Refused(f"{said.name} has no topics of robots")
            if self._replay is not None:
                await self._replay.stop()
            names = {robot: self._service.first_replay + number for number, robot in enumerate(robots)}
            words = ["replay", *self._service.mesh, "--loop", "--start", f"{said.start_s:.3f}s"]
            words += [word for old, new in names.items() for word in ("--as-robot", f"{old}:{new}")]
            words += ["--", str(self._folder.file(said.name))]
            as_robots = {str(old): new for old, new in names.items()}
            self._replayed = {"name": said.name, "start_s": said.start_s, "robots": as_robots}
            self._problems.pop("replay", None)
            self._replay = playing = await Child.spawned(words, self._ended)
            await playing.ready()
            asyncio.get_running_loop().call_later(PLAYED_S, self._played_enough, playing)
            return self._replayed

    async def _stop_playing(self, _: Nothing) -> dict[str, Any]:
        async with self._turn:
            if self._replay is None:
                raise Refused("nothing is being played")
            await self._replay.stop()
            return {}

    async def _happened(self, request: web.Request) -> web.Response:
        async with self._reading:
            try:
                return _json(await asyncio.to_thread(self._folder.happened, request.match_info["name"]))
            except MacsError as error:
                return _json({"error": str(error)}, 404)

    async def _file_of(self, request: web.Request) -> web.StreamResponse:
        try:
            path = await asyncio.to_thread(self._folder.file, request.match_info["name"])
        except UsageError as error:
            return _json({"error": str(error)}, 404)
        return web.FileResponse(path, chunk_size=256 << 10)

    # -- programs ------------------------------------------------------------------------------------------------

    async def _record(self, words: Sequence[str], path: Path) -> Child:
        most = ("--max-folder", str(self._service.most_bytes))
        words = ["record", *self._service.mesh, *words, *most, "--json", "--progress", "-o", str(path)]
        return await Child.spawned(words, self._ended)

    async def _begin_ring(self) -> None:
        self._ring = ring = await self._record(self._service.ring, self._folder.path / "ring.mcap")
        await ring.ready()

    async def _keep_ring(self) -> None:
        """Begin it again where it has ended."""
        while True:
            await self._ring_gone.wait()
            await asyncio.sleep(RING_AGAIN_S)
            self._ring_gone.clear()
            try:
                await self._begin_ring()
                self._problems.pop("ring", None)
                log.info("the ring goes on, without what it had")
            except (Refused, OSError) as error:
                self._ring_gone.set()
                log.error("the ring does not begin: %s", error)

    def _played_enough(self, child: Child) -> None:
        """Nobody looks at it any more, as likely as not."""
        if child is self._replay:
            child.signal(signal.SIGTERM)

    def _ended(self, child: Child) -> None:
        problem = child.problem
        if child is self._recording:
            self._recording = None
            self._tell("recording", f"{self._file} has ended: {problem}" if problem else "")
            log.info("%s is recorded", self._file)
        elif child is self._ring:
            self._ring = None
            self._ring_gone.set()
            self._tell("ring", f"the ring has ended: {problem or 'somebody has ended it'}; it begins again")
        elif child is self._replay:
            self._replay = None
            self._tell("replay", f"the replay has ended: {problem}" if problem else "")

    def _tell(self, what: str, problem: str) -> None:
        if problem and not self._closing:
            self._problems[what] = problem
            log.error("%s", problem)


def _is_ready(child: Child | None) -> TypeGuard[Child]:
    """Whether it does its work: what has only begun is not shown as if it recorded."""
    return child is not None and child.is_ready


def _take_over(path: Path) -> None:
    """Take away a socket that nobody serves any more. Raises UsageError: somebody does."""
    probe = socket.socket(socket.AF_UNIX)
    try:
        probe.connect(str(path))
    except ConnectionRefusedError:
        path.unlink(missing_ok=True)
    except FileNotFoundError:
        pass
    else:
        raise UsageError(f"{path.parent} has a recorder already")
    finally:
        probe.close()


def _json(document: dict[str, Any], status: int = 200) -> web.Response:
    return web.Response(body=msgspec.json.encode(document), content_type="application/json", status=status)
