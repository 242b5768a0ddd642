"""A TCP link to a router whose bytes are counted, and which can stand still or be cut."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress


class Link:
    """What went over the link."""

    def __init__(self) -> None:
        self.endpoint = ""
        self.up_bytes = 0
        """Towards the router."""
        self.down_bytes = 0
        self._moves = asyncio.Event()
        self._moves.set()
        self._comes = asyncio.Event()
        self._comes.set()
        self.is_cut = False
        self.ends: set[asyncio.StreamWriter] = set()

    def cut(self) -> None:
        """End all connections at once, and let no new one come about until `mend`."""
        self.is_cut = True
        for end in self.ends:
            end.transport.abort()

    def mend(self) -> None:
        """Whoever tries again gets through."""
        self.is_cut = False

    def hold(self) -> None:
        """From now on nothing goes towards the router, as on a link that is full: what is sent waits."""
        self._moves.clear()

    def hold_down(self) -> None:
        """The same for what comes from the router."""
        self._comes.clear()

    def release(self) -> None:
        """What waits goes on."""
        self._moves.set()
        self._comes.set()

    async def moves(self, *, up: bool) -> None:
        """Wait while the link is held."""
        await (self._moves if up else self._comes).wait()


@asynccontextmanager
async def counted(router: str, *, buffer_bytes: int | None = None, delay_s: float = 0.0) -> AsyncIterator[Link]:
    """A counting relay in front of the router at this endpoint; connect to ``link.endpoint``.

    ``buffer_bytes`` is what the kernel holds on either side of a link; otherwise it is megabytes on this machine.
    ``delay_s`` is how much longer everything takes, either way.
    """
    link = Link()
    host, _, port = router.removeprefix("tcp/").rpartition(":")
    tasks: set[asyncio.Task[None]] = set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, up: bool) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                await link.moves(up=up)
                link.up_bytes += len(data) if up else 0
                link.down_bytes += 0 if up else len(data)
                if delay_s:
                    asyncio.get_running_loop().call_later(delay_s, writer.write, data)
                    continue
                writer.write(data)
                await writer.drain()
        writer.close()
        link.ends.discard(writer)

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if link.is_cut:
            writer.transport.abort()
            return
        try:
            router_reader, router_writer = await asyncio.open_connection(host, int(port))
        except OSError:  # the router is down
            writer.transport.abort()
            return
        link.ends |= {writer, router_writer}
        tasks.add(asyncio.create_task(pump(reader, router_writer, up=True)))
        tasks.add(asyncio.create_task(pump(router_reader, writer, up=False)))

    listener = socket.create_server(("127.0.0.1", 0))
    link.endpoint = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
    if buffer_bytes is not None:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        link.endpoint += f"#so_sndbuf={buffer_bytes}"
    server = await asyncio.start_server(accept, sock=listener)
    try:
        yield link
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


@asynccontextmanager
async def delayed(endpoint: str, delay_s: float) -> AsyncIterator[str]:
    """A relay in front of a router, by which all takes so much longer in either direction."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    loop = asyncio.get_running_loop()
    tasks: set[asyncio.Task[None]] = set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                loop.call_later(delay_s, writer.write, data)
        loop.call_later(delay_s, writer.close)

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection(host, int(port))
        for one, other in ((reader, back), (there, writer)):
            tasks.add(asyncio.create_task(pump(one, other)))

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    try:
        yield f"tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}"
    finally:
        server.close()
        for task in tasks:
            task.cancel()
