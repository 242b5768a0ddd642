"""A relay between a headset and its gateway that does what it likes with commands, and passes on all else."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress

from macs_zenoh.protocol.messages import Metadata, NodeType
from macs_zenoh.protocol.wire import parse_frame

_SIZES = struct.Struct("<II")
_HEADER_BYTES = 39

Meddle = Callable[[bytes], list[tuple[float, bytes]]]
"""What becomes of a command: frames, each with how long it waits, in s."""


def as_it_comes(frame: bytes) -> list[tuple[float, bytes]]:
    """Nothing is done to it."""
    return [(0.0, frame)]


class Relay:
    """Connect to ``port`` of 127.0.0.1. ``meddle`` may be changed at any time; ``commands`` are counted."""

    def __init__(self) -> None:
        self.port = 0
        self.meddle: Meddle = as_it_comes
        self.commands = 0

    def frames(self, frame: bytes) -> list[tuple[float, bytes]]:
        """What goes on in a frame's place."""
        parsed = parse_frame(frame)
        if parsed.has_management or not parsed.metadata:
            return as_it_comes(frame)
        if Metadata.decode(parsed.metadata).node_type != NodeType.PUBLISHER:
            return as_it_comes(frame)
        self.commands += 1
        return self.meddle(frame)


@asynccontextmanager
async def relay(target: int) -> AsyncIterator[Relay]:
    """In front of a gateway at this port."""
    self = Relay()
    tasks: set[asyncio.Task[None]] = set()
    loop = asyncio.get_running_loop()

    async def up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            while True:
                header = await reader.readexactly(_HEADER_BYTES)
                body = await reader.readexactly(sum(_SIZES.unpack_from(header, 31)))
                for wait_s, frame in self.frames(header + body):
                    if wait_s:
                        loop.call_later(wait_s, writer.write, frame)
                    else:
                        writer.write(frame)
                await writer.drain()
        writer.close()

    async def down(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
        writer.close()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        gateway_reader, gateway_writer = await asyncio.open_connection("127.0.0.1", target)
        tasks.add(asyncio.create_task(up(reader, gateway_writer)))
        tasks.add(asyncio.create_task(down(gateway_reader, writer)))

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    self.port = server.sockets[0].getsockname()[1]
    try:
        yield self
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
