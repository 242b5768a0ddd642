"""How much is read at once of a connection to the web port, and when none is, whatever aiohttp allows."""

from __future__ import annotations

import asyncio
from typing import Any, cast

from bridge.gateway.shares import LATE_READ_BYTES, TURN_S, Rounds, Share
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


async def test_late_in_a_long_round_little_is_read() -> None:
    """Whoever the round's work was for; what is left comes in the next one."""
    clock = [100.0]
    transport, inner, port = Transport(), Inner(), Port()
    port.rounds = Rounds(lambda: clock[0])
    outer = _Outer(cast(asyncio.Protocol, inner), cast(Any, port))
    outer.connection_made(cast(asyncio.BaseTransport, transport))
    for number in range(3):
        clock[0] += TURN_S
        port.rounds.spend(f"10.0.0.{number}", Share(), 0.9 * TURN_S)
    for size in (LATE_READ_BYTES - 1, LATE_READ_BYTES):
        assert transport.reads
        assert len(outer.get_buffer(-1)) == LATE_READ_BYTES
        outer.buffer_updated(size)
    assert not transport.reads
    await asyncio.sleep(0)
    assert transport.reads
    assert len(outer.get_buffer(-1)) == LEAST_READ_BYTES
    outer._stop_waiting()
