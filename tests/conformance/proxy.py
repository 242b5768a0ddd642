"""A proxy that makes one mistake: between the conformance kit and a right program it is a wrong one."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from macs_zenoh.protocol.wire import encode_message

Rewrite = Callable[[bytes, "Link"], list[bytes]]


class Link:
    """One connection through the proxy; ``notes`` is for what its fault remembers, ``shared`` for that of all."""

    def __init__(self, proxy: Proxy, to_agent: asyncio.StreamWriter, to_router: asyncio.StreamWriter) -> None:
        self.proxy = proxy
        self.notes = SimpleNamespace()
        self.to_agent = to_agent
        self.to_router = to_router

    def close(self) -> None:
        for writer in (self.to_agent, self.to_router):
            writer.close()


class Proxy:
    """``frame`` rewrites what an agent says, ``message`` what a router says: each into any number of pieces."""

    def __init__(self, port: int, frame: Rewrite | None = None, message: Rewrite | None = None) -> None:
        self.port = 0
        self.links: list[Link] = []
        self.agents: dict[int, Link] = {}
        self.shared = SimpleNamespace()
        self._target = port
        self._frame = frame
        self._message = message
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Proxy:
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self.stop_listening()
        for link in self.links:
            link.close()
        for task in self._tasks:
            task.cancel()

    def stop_listening(self) -> None:
        self._server.close()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            from_router, to_router = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.transport.abort()
            return
        link = Link(self, writer, to_router)
        self.links.append(link)
        for source, target, size, rewrite in (
            (reader, to_router, frame_size, self._frame),
            (from_router, writer, message_size, self._message),
        ):
            task = asyncio.create_task(_pass_on(source, target, size, rewrite, link))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)


async def _pass_on(
    source: asyncio.StreamReader,
    target: asyncio.StreamWriter,
    size: Callable[[bytes], int],
    rewrite: Rewrite | None,
    link: Link,
) -> None:
    held = b""
    with contextlib.suppress(OSError):
        while data := await source.read(1 << 16):
            held += data
            pieces, held = whole(held, size) if rewrite is not None else ([held], b"")
            for piece in pieces:
                for each in rewrite(piece, link) if rewrite is not None else [piece]:
                    target.write(each)
            await target.drain()
    with contextlib.suppress(OSError):
        target.close()


def whole(data: bytes, size: Callable[[bytes], int]) -> tuple[list[bytes], bytes]:
    """Whole frames or messages, and what is left; what declares more than any has passes as it is."""
    pieces = []
    while data:
        wanted = size(data)
        if wanted > 1 << 26:
            return [*pieces, data], b""
        if wanted < 0 or len(data) < wanted:
            break
        pieces.append(data[:wanted])
        data = data[wanted:]
    return pieces, data


def frame_size(data: bytes) -> int:
    if len(data) < 39:
        return -1
    return 39 + int.from_bytes(data[31:35], "little") + int.from_bytes(data[35:39], "little")


def message_size(data: bytes) -> int:
    if len(data) < 4:
        return -1
    data_at = 4 + int.from_bytes(data[:4], "little")
    if data_at > 1 << 26:
        return data_at
    if len(data) < data_at + 4:
        return -1
    return data_at + 4 + int.from_bytes(data[data_at : data_at + 4], "little")


def parts(message: bytes) -> tuple[Any, bytes]:
    """Metadata and data of a message; None for metadata that cannot be read."""
    end = 4 + int.from_bytes(message[:4], "little")
    try:
        metadata = json.loads(message[4:end])
    except (ValueError, RecursionError):
        metadata = None
    return metadata if isinstance(metadata, dict) else None, message[end + 4 :]


def said(frame: bytes) -> dict[str, Any]:
    """Management data of a frame; empty when there is none that can be read."""
    try:
        found = json.loads(frame[39 : 39 + int.from_bytes(frame[31:35], "little")])
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def with_management(frame: bytes, **changed: Any) -> bytes:
    """The frame with other management data."""
    size = int.from_bytes(frame[31:35], "little")
    raw = json.dumps({**said(frame), **changed}).encode()
    return frame[:31] + len(raw).to_bytes(4, "little") + frame[35:39] + raw + frame[39 + size :]


def with_message(frame: bytes, message: bytes) -> bytes:
    """The frame with another message."""
    size = int.from_bytes(frame[31:35], "little")
    return frame[:35] + len(message).to_bytes(4, "little") + frame[39 : 39 + size] + message


def message_of(frame: bytes) -> bytes:
    return frame[39 + int.from_bytes(frame[31:35], "little") :]


def changed(message: bytes, **fields: Any) -> bytes:
    """The message with other metadata."""
    metadata, data = parts(message)
    return encode_message(json.dumps({**metadata, **fields}).encode(), data)
