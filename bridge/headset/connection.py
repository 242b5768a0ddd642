"""One TCP connection of a headset: whole messages in, frames out."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import deque

from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol import greetings
from macs_zenoh.protocol.addresses import joined
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.timeouts import within

from .stream import TCP, Stream, Way, open_stream

log = logging.getLogger("macs.headset")

_DRAIN_ABOVE_BYTES = 256 << 10
_GOODBYE_S = 1.0
_SILENT_S = 0.5
"""A gateway speaks at once, unless it waits for an id to give; who is silent for so long may be a Zenoh router."""


class Connection:
    """An open connection; it ends with Unreachable wherever it is used."""

    def __init__(
        self,
        stream: Stream,
        place: tuple[str, int],
        max_message_bytes: int,
    ) -> None:
        self.target = joined(*place)
        self._place = place
        self.last_output = 0.0
        self._stream = stream
        self._decoder = MessageDecoder(max_message_bytes, skip_large=True)
        self.too_large = 0
        """How many messages were let go of because they were."""
        self.taken = 0
        """How many messages were taken from here."""
        self._whole: deque[bytes] = deque()
        self._draining = asyncio.Lock()

    @classmethod
    async def open(
        cls, host: str, port: int, *, timeout_s: float, max_message_bytes: int, way: Way = TCP
    ) -> Connection:
        """Connect. Raises Unreachable."""
        target = joined(host, port)
        try:
            stream = await within(open_stream(host, port, way), timeout_s)
        except asyncio.TimeoutError as error:
            raise Unreachable(target, f"no connection within {timeout_s:g} s") from error
        except OSError as error:
            raise Unreachable(target, error.strerror or str(error)) from error
        return cls(stream, (host, port), max_message_bytes)

    async def receive_first(self, timeout_s: float) -> bytes:
        """The router's first message. Raises Unreachable when none comes within ``timeout_s``: a Zenoh router, which
        waits for us, is recognised sooner."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        receiving = loop.create_task(self.receive())
        looking = loop.create_task(self._waits_for_zenoh(min(_SILENT_S, timeout_s)))
        try:
            await asyncio.wait([receiving, looking], timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            if not receiving.done() and looking.done() and looking.result():
                raise Unreachable(self.target, "that is a Zenoh router; headsets connect to a gateway")
            await asyncio.wait([receiving], timeout=max(0.0, deadline - loop.time()))
            if not receiving.done():
                raise Unreachable(self.target, f"it sent no id within {timeout_s:g} s")
            return receiving.result()
        finally:
            receiving.cancel()
            looking.cancel()

    async def _waits_for_zenoh(self, silent_s: float) -> bool:
        """Whether a Zenoh router is there, asked on a connection of its own after so long without a word."""
        await asyncio.sleep(silent_s)
        writer: asyncio.StreamWriter | None = None
        try:
            reader, writer = await asyncio.open_connection(*self._place)
            writer.write(greetings.INIT_SYN)
            return greetings.is_zenoh(await within(reader.read(greetings.ENOUGH_BYTES), _SILENT_S))
        except (OSError, asyncio.TimeoutError):
            return False
        finally:
            if writer is not None:
                writer.transport.abort()

    async def receive(self) -> bytes:
        """The next whole message. Raises Unreachable at the end of the connection, FrameTooLarge."""
        while not self._whole:
            try:
                data = await self._stream.read()
            except OSError as error:
                raise Unreachable(self.target, error.strerror or str(error)) from error
            if not data:
                raise Unreachable(self.target, "the router closed the connection")
            self._whole.extend(self._decoder.feed(data))
            self._note_skipped()
        self.taken += 1
        return self._whole.popleft()

    @property
    def received(self) -> int:
        """How many messages have come and are dealt with."""
        return self.taken + self.too_large

    @property
    def closing(self) -> bool:
        """Whether nothing can be sent any more."""
        return self._stream.closing

    def _note_skipped(self) -> None:
        for skipped in self._decoder.skipped:
            self.too_large += 1
            limit = self._decoder.max_message_bytes
            about = skipped.metadata[:400].decode("utf-8", "backslashreplace")
            log.warning("a message of %d bytes was dropped, more than %d: %r", skipped.size, limit, about)
        self._decoder.skipped.clear()

    async def send(self, frame: bytes) -> None:
        """Write one frame; wait only while much is unsent. Raises Unreachable when the connection is gone."""
        if self._stream.closing:
            raise Unreachable(self.target, "the connection is closed")
        self._stream.write(frame)
        self.last_output = asyncio.get_running_loop().time()
        if self._stream.unsent <= _DRAIN_ABOVE_BYTES:
            return
        try:
            async with self._draining:  # before Python 3.11 only one task may wait at a time
                await self._stream.drain()
        except OSError as error:
            raise Unreachable(self.target, error.strerror or str(error)) from error

    @property
    def unsent(self) -> int:
        """How many bytes wait to be sent."""
        return self._stream.unsent

    def put(self, frame: bytes) -> None:
        """Write one frame without waiting, for who looks at `unsent`; nothing, when the connection is gone."""
        if not self._stream.closing:
            self._stream.write(frame)
            self.last_output = asyncio.get_running_loop().time()

    async def close(self) -> None:
        """Send what is written, then close. Waits at most a second for a peer that does not take it."""
        with contextlib.suppress(OSError, asyncio.TimeoutError, RuntimeError):
            self._stream.finish()
            await within(self._read_to_end(), _GOODBYE_S)
        self.abort()

    def abort(self) -> None:
        """Drop the connection without a word, as a headset that lost power."""
        self._stream.abort()

    async def _read_to_end(self) -> None:
        while await self._stream.read():
            pass
