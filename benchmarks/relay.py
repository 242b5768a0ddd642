"""The other baseline: what a MACS router costs when it is nothing but asyncio. No Zenoh, no checks, one process.

It reads the same frames (39-byte header, then the sizes it declares), writes the message to the agents named by id,
by group or all, and holds a sender back while one of its receivers is full. It takes any management data for the
agent's configuration or a heartbeat.

``python -m benchmarks.relay CERTIFICATE KEY`` does it over TLS: what that costs whoever relays with asyncio.
"""

from __future__ import annotations

import asyncio
import ssl
import struct
import sys
from typing import Any, cast

import uvloop

from macs_zenoh.protocol.messages import Configuration, Metadata, Welcome, decode_management, encode_data
from macs_zenoh.protocol.wire import encode_message

HEADER = struct.Struct("<B10H10BII")


class Agent(asyncio.Protocol):
    """One connection."""

    def __init__(self, agents: dict[int, Agent]) -> None:
        self.agents = agents
        self.id = 0
        self.group = 0
        self.transport: asyncio.Transport
        self.full = False
        self.held: list[Agent] = []
        self.buffer = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Give it an id and tell it."""
        self.transport = cast(asyncio.Transport, transport)
        self.transport.set_write_buffer_limits(high=256 << 10)
        self.id = next(i for i in range(1, 65536) if i not in self.agents)
        self.agents[self.id] = self
        welcome = Metadata(request_id=self.id, message_manager=Welcome.manager)
        self.transport.write(encode_message(welcome.encode(), encode_data(Welcome(self.id))))

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        del self.agents[self.id]
        self.resume_writing()

    def data_received(self, data: bytes) -> None:
        """Pass on every frame that is whole."""
        buffer = self.buffer
        buffer += data
        start, end = 0, len(buffer)
        while end - start >= HEADER.size:
            fields = HEADER.unpack_from(buffer, start)
            message_at = start + HEADER.size + fields[-2]
            message_end = message_at + fields[-1]
            if message_end > end:
                break
            if fields[-2]:
                self.manage(bytes(buffer[start + HEADER.size : message_at]))
            else:
                with memoryview(buffer) as view:
                    message = bytes(view[message_at:message_end])
                for target in self.targets(fields):
                    target.transport.write(message)
                    if target.full:
                        target.hold(self)
            start = message_end
        if start:
            del buffer[:start]

    def targets(self, fields: tuple[Any, ...]) -> list[Agent]:
        """Who gets a frame with this header."""
        if fields[0] == 0:
            return [agent for agent in self.agents.values() if agent is not self]
        named = [self.agents[i] for i in fields[1:11] if i in self.agents]
        groups = set(fields[11:21]) - {0}
        if not groups:
            return named
        return named + [a for a in self.agents.values() if a.group in groups and a is not self and a not in named]

    def manage(self, management: bytes) -> None:
        """Learn its group."""
        told = decode_management(management)
        if isinstance(told, Configuration):
            self.group = told.group_id

    def hold(self, sender: Agent) -> None:
        """Let a sender wait until there is room."""
        if sender not in self.held:
            self.held.append(sender)
            sender.transport.pause_reading()

    def pause_writing(self) -> None:
        """It does not read fast enough."""
        self.full = True

    def resume_writing(self) -> None:
        """There is room again."""
        self.full = False
        held, self.held = self.held, []
        for sender in held:
            sender.transport.resume_reading()


async def main() -> None:
    """Relay until stopped."""
    agents: dict[int, Agent] = {}
    tls = None
    if len(sys.argv) > 1:
        tls = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        tls.load_cert_chain(*sys.argv[1:3])
    server = await asyncio.get_running_loop().create_server(lambda: Agent(agents), "127.0.0.1", 0, ssl=tls)
    print(f"ready: relay on 127.0.0.1:{server.sockets[0].getsockname()[1]}", flush=True)
    ended = asyncio.Event()
    asyncio.get_running_loop().add_reader(sys.stdin.fileno(), ended.set)  # nothing is ever sent there: its end
    await ended.wait()


if __name__ == "__main__":
    uvloop.run(main())
