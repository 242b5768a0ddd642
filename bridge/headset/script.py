"""What ``macs headset`` runs: one verb, or a script of them on one connection. Results are JSON lines."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import shlex
import sys
import threading
from collections.abc import AsyncIterator, Coroutine
from pathlib import Path
from typing import Any

from macs_zenoh.errors import CallTimeout, MacsError, UsageError
from macs_zenoh.timeouts import within

from .client import Headset
from .session import Emit, Session
from .stream import Way
from .verbs import WebTarget, script_parser

_BACKGROUND = {"sub", "serve", "listen"}


async def perform(args: argparse.Namespace, emit: Emit) -> int:
    """Do what the command line says: connect, perform one verb or a script, go offline. Returns the exit code.

    ``args`` is what `verbs` and ``macs headset`` parse. Cancelling is a way to stop: 0 for a verb that has no
    end of its own, otherwise 130. Raises Unreachable, UsageError.
    """
    session = Session(emit, args.types)
    if args.headset_verb != "run":
        session.prepare(args)
    host, port, *_ = args.target
    try:
        headset = await Headset.connect(
            host, port, group=args.group, reconnect=args.reconnect, token=args.token, way=_way(args)
        )
        async with headset:
            session.use(headset)
            if args.headset_verb != "run":
                return await (await session.start(args)).work
            lines = stdin_lines() if args.file == "-" else file_lines(args.file)
            return await Script(session, emit, keep_going=args.keep_going).run(lines)
    except asyncio.CancelledError:
        return session.stopped_code


def _way(args: argparse.Namespace) -> Way:
    """How the command line wants the gateway to be reached."""
    web = args.target if isinstance(args.target, WebTarget) else None
    return Way(websocket=web is not None, tls=args.tls or bool(web and web.tls) or bool(args.ca), authority=args.ca)


class Script:
    """Runs the lines of a script on one session. Results and failures are JSON lines; the exit code sums them up."""

    def __init__(self, session: Session, emit: Emit, *, keep_going: bool = False) -> None:
        self._session = session
        self._emit = emit
        self._keep_going = keep_going
        self._parser = script_parser()
        self._jobs: dict[asyncio.Task[int], bool] = {}
        self._code = 0

    async def run(self, lines: AsyncIterator[str]) -> int:
        """Perform every line, then wait for the background jobs that have an end. Returns the exit code."""
        headset = self._session.headset
        self._emit({"connected": headset.id, "group": headset.group})
        number = 0
        try:
            async for line in lines:
                number += 1
                try:
                    await self._perform(line)
                except MacsError as error:
                    self._fail(f"line {number}: {error}", error)
                    if not self._keep_going:
                        return self._code
            await self._wait_all(None)
        finally:
            await self._stop_jobs()
        return self._code

    async def _perform(self, line: str) -> None:
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise UsageError(str(error)) from error
        if not words:
            return
        in_background = words[-1] == "&"
        args = self._parser.parse_args(words[:-1] if in_background else words)
        if await self._perform_script_verb(args):
            return
        job = await self._session.start(args)
        if in_background or args.headset_verb in _BACKGROUND:
            self._emit({"started": args.headset_verb, **_named(args)})
            task = asyncio.get_running_loop().create_task(self._in_background(job.work))
            self._jobs[task] = job.endless
        else:
            self._code = max(self._code, await job.work)

    async def _perform_script_verb(self, args: argparse.Namespace) -> bool:
        """Do a verb that only scripts have. Returns whether it was one."""
        headset = self._session.headset
        verb = args.headset_verb
        if verb == "wait":
            await self._wait(args)
        elif verb == "sleep":
            await asyncio.sleep(args.seconds)
        elif verb == "group":
            await headset.set_group(args.group)
        elif verb == "unsub":
            nodes = [node for node in headset.nodes if node.spec.tos_name == args.topic]
            if not nodes:
                raise UsageError(f"there is no node for {args.topic}")
            for node in nodes:
                await node.close()
        elif verb == "pause":
            headset.pause()
        elif verb == "resume":
            headset.resume()
        elif verb == "drop":
            headset.drop_connection()
        else:
            return False
        self._emit({"done": verb})
        return True

    async def _wait(self, args: argparse.Namespace) -> None:
        if args.what is None:
            await self._wait_all(args.timeout)
            return
        try:
            await within(self._session.wait_for(args.what, args.count), args.timeout)
        except asyncio.TimeoutError as error:
            raise CallTimeout(f"{args.count} of {args.what}", args.timeout) from error

    async def _wait_all(self, timeout_s: float | None) -> None:
        ending = [task for task, endless in self._jobs.items() if not endless and not task.done()]
        if not ending:
            return
        _, waiting = await asyncio.wait(ending, timeout=timeout_s)
        if waiting:
            raise CallTimeout("the end of background verbs", timeout_s or 0.0)

    async def _in_background(self, work: Coroutine[Any, Any, int]) -> int:
        try:
            code = await work
        except MacsError as error:
            self._fail(str(error), error)
            return self._code
        self._code = max(self._code, code)
        return code

    def _fail(self, text: str, error: MacsError) -> None:
        self._emit({"error": text})
        self._code = max(self._code, 2 if isinstance(error, UsageError) else 1)

    async def _stop_jobs(self) -> None:
        for task in self._jobs:
            task.cancel()
        for ended in await asyncio.gather(*self._jobs, return_exceptions=True):
            if isinstance(ended, Exception):  # of ours, or results cannot be written
                raise ended


async def file_lines(path: str) -> AsyncIterator[str]:
    """The lines of a file. Raises UsageError when it cannot be read."""
    try:
        text = Path(path).read_text(encoding="utf-8")  # noqa: ASYNC240 - a short file, before anything runs
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    for line in text.splitlines():
        yield line


async def stdin_lines() -> AsyncIterator[str]:
    """The lines of stdin as they come, from a terminal, a pipe or a file."""
    loop = asyncio.get_running_loop()
    lines: asyncio.Queue[str | None] = asyncio.Queue()

    def read() -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody wants more lines
            for line in sys.stdin:
                loop.call_soon_threadsafe(lines.put_nowait, line)
            loop.call_soon_threadsafe(lines.put_nowait, None)

    # A daemon thread, because nothing can interrupt a read of stdin.
    threading.Thread(target=read, name="stdin", daemon=True).start()
    while (line := await lines.get()) is not None:
        yield line


def _named(args: argparse.Namespace) -> dict[str, str]:
    return {"name": args.topic} if hasattr(args, "topic") else {}
