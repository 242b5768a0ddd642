"""Numbers that one session puts and another receives: what is missing, comes twice or out of order is seen."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator
from contextlib import suppress

from macs_zenoh.mesh import Mesh, Sample, Traffic

HZ = 200


class Numbers:
    """The numbers that a subscription received."""

    def __init__(self) -> None:
        self.heard: list[int] = []
        self.missed: list[tuple[str, int]] = []

    def take(self, batch: Iterator[Sample]) -> None:
        self.heard += [int.from_bytes(payload, "big") for _, payload in batch]

    def miss(self, key: str, count: int) -> None:
        self.missed.append((key, count))


class Stream:
    """Puts numbers on keys 200 times a second, until the block is left; ``sent`` counts."""

    def __init__(self, mesh: Mesh, *keys: str, traffic: Traffic = Traffic.STREAM, size: int = 8) -> None:
        self.sent = 0
        self._mesh, self._keys, self._traffic, self._size = mesh, keys, traffic, size

    async def __aenter__(self) -> Stream:
        self._task = asyncio.create_task(self._run())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task

    async def _run(self) -> None:
        due = time.monotonic()
        while True:
            due += 1 / HZ
            for key in self._keys:
                self._mesh.put(key, self.sent.to_bytes(self._size, "big"), self._traffic)
            self.sent += 1
            await asyncio.sleep(max(0.0, due - time.monotonic()))
