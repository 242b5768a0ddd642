"""A network between a headset and its gateway, which can be lost in each of the ways in which networks are."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Literal

Loss = Literal["rst", "fin", "silence"]


class Network:
    """Connect to ``port`` of 127.0.0.1. ``address`` is where its connections seem to come from."""

    def __init__(self, target: int) -> None:
        self.target = target
        self.port = 0
        self.address = "127.0.0.1"
        self.is_cut = False
        """Whether nobody gets through."""
        self.connections = 0
        """How many there have been."""
        self._ends: list[asyncio.StreamWriter] = []
        self._silent: list[asyncio.StreamWriter] = []
        self._pumps: set[asyncio.Task[None]] = set()

    def lose(self, how: Loss) -> None:
        """All connections that there are: both ends hear of it at once by a reset or an end, or neither does."""
        ends, self._ends = self._ends, []
        for pump in self._pumps:
            pump.cancel()
        for end in ends:
            if end.is_closing():
                continue
            if how == "silence":
                end.transport.pause_reading()  # type: ignore[attr-defined]
                self._silent.append(end)
            elif how == "fin":
                end.close()
            else:
                raw = end.get_extra_info("socket")
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                end.transport.abort()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.is_cut:
            writer.transport.abort()
            return
        try:
            away_reader, away = await asyncio.open_connection("127.0.0.1", self.target, local_addr=(self.address, 0))
        except OSError:
            writer.transport.abort()
            return
        self.connections += 1
        self._ends += [writer, away]
        self._start(reader, away)
        self._start(away_reader, writer)

    def _start(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        pump = asyncio.get_running_loop().create_task(self._pump(reader, writer))
        self._pumps.add(pump)
        pump.add_done_callback(self._pumps.discard)

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await reader.read(65536):
                writer.write(data)
                await writer.drain()
            writer.close()

    def close(self) -> None:
        """End all of it."""
        self.lose("rst")
        for end in self._silent:
            end.transport.abort()


@asynccontextmanager
async def network(target: int) -> AsyncIterator[Network]:
    """One before this port of 127.0.0.1."""
    found = Network(target)
    server = await asyncio.start_server(found._accept, "127.0.0.1", 0)
    found.port = server.sockets[0].getsockname()[1]
    try:
        yield found
    finally:
        server.close()
        found.close()
