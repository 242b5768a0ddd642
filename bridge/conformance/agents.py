"""One connection of an agent that the kit plays: vectors out, whole messages in."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from macs_zenoh.errors import Unreachable, WireError
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.wire import split_message
from macs_zenoh.timeouts import within

from . import vectors
from .checks import NotHeld
from .vectors import Value

_READ_BYTES = 64 << 10


class Received(NamedTuple):
    """A message as it came; ``fields`` of its metadata are empty when that is no JSON object."""

    raw: bytes
    metadata: bytes
    fields: dict[str, Any]
    data: bytes

    @property
    def manager(self) -> str:
        """Which manager its metadata names."""
        return str(self.fields.get("messageManager", ""))

    def json(self) -> dict[str, Any]:
        """Its data as a JSON object; empty when it is none."""
        return json_object(self.data)


def json_object(data: bytes) -> dict[str, Any]:
    """The object that ``data`` is, an empty one when it is none."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def as_received(raw: bytes) -> Received:
    """A whole message, taken apart."""
    try:
        metadata, data = split_message(raw, len(raw))
    except WireError:
        return Received(raw, b"", {}, b"")
    return Received(raw, metadata, json_object(metadata), bytes(data))


class Agent:
    """A connection to the program under test. What has come is kept until somebody asks for it."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, patience_s: float) -> None:
        self.id = 0
        """Under which id others reach it."""
        self.request = 0
        """The requestId of its router's first message."""
        self.group = 0
        self.kind = 2
        self.messages: list[Received] = []
        self.looked_at = 0
        """How many messages have come and were waited for, or let go of."""
        self.ended = False
        self.problem = ""
        self._reader = reader
        self._writer = writer
        self._patience_s = patience_s
        self._decoder = MessageDecoder()
        self._come = asyncio.Condition()
        self._reading = asyncio.create_task(self._read())

    @classmethod
    async def open(cls, host: str, port: int, patience_s: float) -> Agent:
        """Connect. Raises Unreachable."""
        try:
            reader, writer = await within(asyncio.open_connection(host, port), patience_s)
        except (OSError, asyncio.TimeoutError) as error:
            why = getattr(error, "strerror", None) or f"no connection within {patience_s:g} s"
            raise Unreachable(joined(host, port), why) from error
        return cls(reader, writer, patience_s)

    async def first(self) -> Received:
        """The router's first message; its id and number are the agent's from now on. Raises NotHeld."""
        welcome = await self.wait(lambda message: True, "the first message", 5.0)
        agent_id, request = welcome.json().get("agentId"), welcome.fields.get("requestId")
        if welcome.manager != "AgentConfigurer" or type(agent_id) is not int or type(request) is not int:
            raise NotHeld(f"its first message was {welcome.raw[:200]!r}")
        self.id, self.request = agent_id, request
        return welcome

    async def say(self, name: str, **values: Value) -> None:
        """Send a vector of headsets, or of robots if it is one, as this agent."""
        await self.send(self.frame(name, **values))

    def frame(self, name: str, **values: Value) -> bytes:
        """The same, for who sends it by himself."""
        own: dict[str, Value] = {"id": self.id, "request": self.request, "group": self.group}
        return vectors.fill("robot_frames" if self.kind == 1 else "headset_frames", name, **{**own, **values})

    async def send(self, data: bytes, pieces: Iterable[int] = ()) -> None:
        """Send bytes, cut into pieces that end at these places, each by itself. A lost connection is no error here."""
        start = 0
        with contextlib.suppress(OSError):
            for end in [*pieces, len(data)]:
                self._writer.write(data[start:end])
                start = end
                await within(self._writer.drain(), self._patience_s)
                if end < len(data):
                    await asyncio.sleep(0.001)

    async def wait(self, wanted: Callable[[Received], object], what: str, seconds: float | None = None) -> Received:
        """The first message that is wanted; what came before it is let go of. Raises NotHeld when none comes."""
        seconds = max(seconds or 0.0, self._patience_s)
        found: list[Received] = []

        def look() -> bool:
            while self.messages and not found:
                message = self.messages.pop(0)
                self.looked_at += 1
                if wanted(message):
                    found.append(message)
            return bool(found) or self.ended

        await self._until(look, seconds)
        if found:
            return found[0]
        if self.ended:
            raise NotHeld(f"{what} did not come: {self.problem}")
        raise NotHeld(f"{what} did not come within {seconds:g} s")

    async def until_ended(self) -> None:
        """Wait for the end of the connection. Raises NotHeld."""
        await self._until(lambda: self.ended, self._patience_s)
        if not self.ended:
            raise NotHeld(f"the connection was still open after {self._patience_s:g} s")

    async def _until(self, done: Callable[[], bool], seconds: float) -> None:
        with contextlib.suppress(asyncio.TimeoutError):
            async with self._come:
                await within(self._come.wait_for(done), seconds)

    async def _read(self) -> None:
        try:
            while data := await self._reader.read(_READ_BYTES):
                whole = [as_received(raw) for raw in self._decoder.feed(data)]
                async with self._come:
                    self.messages += whole
                    self._come.notify_all()
            self.problem = "the connection was closed"
        except OSError as error:
            self.problem = f"the connection was lost ({error.strerror or error})"
        except WireError as error:
            self.problem = f"what came is no message: {error}"
        async with self._come:
            self.ended = True
            self._come.notify_all()

    def pause(self) -> None:
        """Read nothing more."""
        self._reading.cancel()

    def reset(self) -> None:
        """End it without a word."""
        self._reading.cancel()
        self._writer.transport.abort()

    def finish(self) -> None:
        """End it as a program does that closes its socket."""
        self._writer.close()

    async def close(self) -> None:
        """End it, and wait until that is done."""
        self._reading.cancel()
        self._writer.close()
        with contextlib.suppress(OSError, asyncio.TimeoutError, asyncio.CancelledError):
            await within(self._writer.wait_closed(), 1.0)
