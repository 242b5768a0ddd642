"""The protocol of worker processes: requests as JSON lines on their standard input, one JSON line back for each.

A request is ``[method, arguments]``, an answer ``{"done": result}`` or ``{"failed": what}``; the first answer says
that it is ready, and it ends with its input. `Worker` is the end that asks, `serve` the one that is asked.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
from collections.abc import Awaitable, Sequence
from typing import Any

from tests.support.processes import STOP_S, Process


class Worker(Process):
    """``python -m MODULE ...``, asked line by line."""

    def __init__(self, module: str, *arguments: str, within: Sequence[str] = ()) -> None:
        super().__init__(sys.executable, "-m", module, *arguments, within=within)
        self._stdin = asyncio.subprocess.PIPE
        self._answers: asyncio.Queue[str] = asyncio.Queue()
        self._turn = asyncio.Lock()

    async def start(self) -> None:
        """Start it, and wait until it is ready."""
        await super().start()
        _result(await self._answers.get(), self)

    async def ask(self, what: str, timeout_s: float = 30.0, **arguments: Any) -> Any:
        """Call one of its methods and return the answer. AssertionError with its log when it fails."""
        async with self._turn:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps([what, arguments]).encode() + b"\n")
            answer = asyncio.ensure_future(self._answers.get())
            ended = asyncio.ensure_future(asyncio.wait(self._reading))
            try:
                await asyncio.wait([answer, ended], timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
                assert answer.done(), f"{self} does not answer {what} {arguments}: {self.tail}"
                return _result(answer.result(), self)
            finally:
                answer.cancel()
                ended.cancel()

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """End it by the end of its input; its exit code."""
        if self._process.returncode is None and number is signal.SIGTERM:
            assert self._process.stdin is not None
            self._process.stdin.close()
            await asyncio.wait({asyncio.ensure_future(self._process.wait())}, timeout=STOP_S)
        return await super().stop(number)

    def _heard(self, line: str, *, is_log: bool) -> bool:
        if not is_log:
            self._answers.put_nowait(line)
        return not is_log


def _result(line: str, worker: Worker) -> Any:
    answer = json.loads(line)
    assert "failed" not in answer, f"{answer['failed']} {worker.tail}"
    return answer["done"]


async def serve(making: Awaitable[object]) -> None:
    """Do what is asked on standard input, by methods of what ``making`` makes, until it ends. Standard output is for
    answers from now on: what others write there, as Zenoh its log, goes to standard error."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(answer: dict[str, Any]) -> None:
        answers.write(json.dumps(answer) + "\n")
        answers.flush()

    worker = await making
    requests = asyncio.StreamReader()
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(requests), sys.stdin)
    say({"done": None})
    while line := await requests.readline():
        what, arguments = json.loads(line)
        try:
            say({"done": await getattr(worker, what)(**arguments)})
        except Exception as error:
            logging.exception("%s failed", what)
            say({"failed": repr(error)})
