"""An HTTP port for who watches a program: it answers GET, one request per connection, and is bounded in everything.

It is no web server. On a robot nothing else has to be installed for it than what writes the figures.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

from bridge.listening import bound
from macs_zenoh.errors import UsageError
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.addresses import bare, is_local, joined, parse
from macs_zenoh.protocol.origins import host_problem
from macs_zenoh.timeouts import within

from .answers import TEXT, Answered, Answers
from .watched import Watched

log = logging.getLogger("macs.metrics")

PORT = 9447
"""Unless another one is said."""
REQUEST_BYTES = 8 << 10
REQUEST_S = 5.0
AT_ONCE, AT_ONCE_EACH = 16, 8
"""Connections, in all and of one address; who comes beyond that is closed."""

_REASONS = {
    200: "OK",
    400: "Bad Request",
    403: "Forbidden",
    404: "Not Found",
    405: "Method Not Allowed",
    501: "Not Implemented",
    503: "Service Unavailable",
}


class Endpoint:
    """The port. ``host`` and ``port`` are where it listens."""

    def __init__(self, answers: Answers, drops: Losses) -> None:
        self._answers = answers
        self._drops = drops
        own = socket.gethostname().lower()
        self._names = frozenset({own, f"{own}.local"})
        self._open: dict[asyncio.Task[None], str] = {}
        """By who answers, whose address it is."""
        self._servers: list[asyncio.Server] = []
        self.port = 0

    async def listen(self, host: str, port: int) -> None:
        """Begin. Raises Unreachable when the port cannot be had."""
        for listening in bound(host, port):
            self._servers.append(await asyncio.start_server(self._connected, sock=listening, limit=REQUEST_BYTES))
            self.port = listening.getsockname()[1]

    async def close(self) -> None:
        """End, with what is being answered."""
        for server in self._servers:
            server.close()
        for task in list(self._open):
            task.cancel()
        await asyncio.gather(*self._open, return_exceptions=True)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        host = str((writer.get_extra_info("peername") or "?")[0])
        from_there = list(self._open.values()).count(host)
        if len(self._open) >= AT_ONCE or from_there >= AT_ONCE_EACH:
            name = "too_many_connections" if len(self._open) >= AT_ONCE else "too_many_from_address"
            self._drops.once(name, "%s is closed: %d watch already, %d from there", host, len(self._open), from_there)
            writer.transport.abort()
            return
        self._open[task] = host
        try:
            await within(self._serve(reader, writer), REQUEST_S)
        except asyncio.TimeoutError:
            self._drops.once("slow_request", "%s is closed: nothing whole for %g s", host, REQUEST_S)
            writer.transport.abort()
        except asyncio.LimitOverrunError:
            self._drops.once("large_request", "%s is closed: it asks with more than %d bytes", host, REQUEST_BYTES)
            writer.transport.abort()
        except (OSError, asyncio.IncompleteReadError):  # it has gone
            writer.transport.abort()
        finally:
            self._open.pop(task, None)
            with suppress(OSError):
                writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await reader.readuntil(b"\r\n\r\n")
        answered = self._answered(head)
        text = f"HTTP/1.1 {answered.status} {_REASONS[answered.status]}\r\n"
        text += f"Content-Type: {answered.media_type}\r\nContent-Length: {len(answered.body)}\r\n"
        text += "Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n"
        writer.write(text.encode() + (b"" if head.startswith(b"HEAD ") else answered.body))
        await writer.drain()

    def _answered(self, head: bytes) -> Answered:
        first, *lines = head.decode("latin-1").split("\r\n")
        words = first.split(" ")
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return Answered(400, b"this is no request\n", TEXT)
        if words[0] not in ("GET", "HEAD"):
            return Answered(405, b"only GET is answered\n", TEXT)
        headers = dict(line.lower().partition(":")[::2] for line in lines if ":" in line)
        if (problem := host_problem(headers.get("host", "").strip(), self._names)) is not None:
            return Answered(403, f"{problem}\n".encode(), TEXT)  # a web page may have had a name lead here
        try:
            return self._answers.fresh(words[1].partition("?")[0], headers.get("accept", "").strip(), time.monotonic())
        except Exception:
            log.exception("answering %s failed", words[1][:80])
            return Answered(503, b"this failed, see the log of the program\n", TEXT)


def parse_address(text: str) -> tuple[str, int]:
    """``HOST:PORT``, with port 0 for any free one, ``PORT`` or ``HOST``. Raises UsageError."""
    host, _, port = text.rpartition(":")
    try:
        if text.isascii() and text.isdigit():
            if int(text) > 0xFFFF:
                raise ValueError(f"{text} is no port")
            return "127.0.0.1", int(text)
        return (bare(host), 0) if port == "0" else parse(text, PORT)
    except ValueError as error:
        raise UsageError(f"--metrics {text}: {error}") from None


@asynccontextmanager
async def watched_at(address: str | None, watched: Watched) -> AsyncIterator[None]:
    """Answer who watches the program, until the end of the block; nothing without an address.

    Raises MissingPrometheus, Unreachable when the port cannot be had, UsageError.
    """
    if address is None:
        yield
        return
    host, port = parse_address(address)
    answers = Answers(watched)
    answers.must_write()
    endpoint = Endpoint(answers, watched.at_port)
    await endpoint.listen(host, port)
    log.info("figures at http://%s/metrics", joined(host, endpoint.port))
    if not is_local(host):
        log.warning("whoever reaches %s sees figures, names of topics and what was lost", joined(host, endpoint.port))
    try:
        yield
    finally:
        await endpoint.close()
