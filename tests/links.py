"""A TCP link to a router whose bytes are counted."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress


class Link:
    """What went over the link."""

    def __init__(self) -> None:
        self.endpoint = ""
        self.up_bytes = 0
        """Towards the router."""
        self.down_bytes = 0


@asynccontextmanager
async def counted(router: str) -> AsyncIterator[Link]:
    """A counting relay in front of the router at this endpoint; connect to ``link.endpoint``."""
    link = Link()
    host, _, port = router.removeprefix("tcp/").rpartition(":")
    tasks: set[asyncio.Task[None]] = set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, up: bool) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                link.up_bytes += len(data) if up else 0
                link.down_bytes += 0 if up else len(data)
                writer.write(data)
                await writer.drain()
        writer.close()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        router_reader, router_writer = await asyncio.open_connection(host, int(port))
        tasks.add(asyncio.create_task(pump(reader, router_writer, up=True)))
        tasks.add(asyncio.create_task(pump(router_reader, writer, up=False)))

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    link.endpoint = f"tcp/127.0.0.1:{server.sockets[0].getsockname()[1]}"
    try:
        yield link
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
