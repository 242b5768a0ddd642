"""Requests of one connection to the web port that wait to be answered, whatever aiohttp allows."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from bridge.gateway.shares import Rounds
from bridge.gateway.web import LEAST_READ_BYTES, PIPELINED, _Outer


class Transport:
    """Whether it is read from."""

    reads = True

    def get_extra_info(self, name: str) -> object:
        return ("127.0.0.1", 1) if name == "peername" else None

    def is_closing(self) -> bool:
        return False

    def pause_reading(self) -> None:
        self.reads = False

    def resume_reading(self) -> None:
        self.reads = True


class Inner:
    """What parses requests, without any limit of its own."""

    def __init__(self) -> None:
        self._messages: list[bytes] = []

    def connection_made(self, transport: object) -> None: ...

    def data_received(self, data: bytes) -> None:
        self._messages += data.split(b"\n")[:-1]

    def answer(self) -> None:
        self._messages.pop(0)


class Port:
    """The port."""

    def __init__(self) -> None:
        self.scratch, self.rounds = memoryview(bytearray(1 << 16)), Rounds()

    def enter(self, host: str) -> bool:
        return True


async def test_no_more_requests_are_read_while_many_wait() -> None:
    """It is read from again when few do, and what comes meanwhile waits in the kernel."""
    transport, inner, port = Transport(), Inner(), Port()
    outer = _Outer(cast(asyncio.Protocol, inner), cast(Any, port))
    outer.connection_made(cast(asyncio.BaseTransport, transport))
    assert len(outer.get_buffer(-1)) == LEAST_READ_BYTES
    asked = b"x\n" * (PIPELINED + 2)
    outer.get_buffer(-1)[: len(asked)] = asked
    outer.buffer_updated(len(asked))
    assert not transport.reads
    inner.answer()
    outer.wait()
    assert not transport.reads
    inner.answer()
    outer.wait()
    assert transport.reads
    outer._stop_waiting()
