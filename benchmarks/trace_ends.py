"""The ends of what `traces` measures: a session that puts a robot's topic, and one that takes it.

``python -m benchmarks.trace_ends put|take PORT EVERY`` joins the router on that port; one in EVERY messages is always
traced there, unless that is 0.
"""

from __future__ import annotations

import asyncio
import sys
import threading
import time
import timeit
from collections.abc import Callable
from typing import Any

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh, Traffic
from macs_zenoh.protocol import trace
from macs_zenoh.protocol.trace import TraceRequest

from .worker import serve

KEY = "macs/from/ros/7/nd__bench"
PREFIX = "macs/from/ros/7/"
LOOKS = 200_000


class Ends:
    """One session, on a loop in a thread of its own."""

    def __init__(self, port: int, every: int) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        settings = MeshSettings(connect=[f"tcp/127.0.0.1:{port}"], trace_every=every)
        self.mesh: Mesh = self._run(Mesh.open(settings))
        self._received = self._wanted = 0
        self._ended = 0.0
        self._all_here = threading.Event()

    def _run(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60)

    def _call(self, work: Callable[[], Any]) -> Any:
        async def called() -> Any:
            return work()

        return self._run(called())

    def subscribe(self) -> dict[str, Any]:
        """Count what comes."""

        def take(batch: Any) -> None:
            self._received += sum(1 for _ in batch)
            if self._received >= self._wanted and not self._all_here.is_set():
                self._ended = time.monotonic()
                self._all_here.set()

        self._call(lambda: self.mesh.subscribe("macs/from/**", take))
        return {}

    def put(self, size: int, count: int) -> dict[str, Any]:
        """Put so many, with a pause where much waits; returns when it began."""
        payload = bytes(size)

        async def putting() -> float:
            began = time.monotonic()
            for number in range(count):
                self.mesh.put(KEY, payload, Traffic.CALL)
                if number % 64 == 63:
                    await asyncio.sleep(0)
                    if self.mesh.backlogged:
                        await self.mesh.drain()
            return began

        return {"began": self._run(putting())}

    def expect(self, count: int) -> dict[str, Any]:
        """Begin to count: ``receive`` waits for so many."""
        self._all_here.clear()
        self._received, self._wanted, self._ended = 0, count, 0.0
        return {}

    def receive(self, timeout_s: float) -> dict[str, Any]:
        """Wait for what `expect` announced."""
        self._all_here.wait(timeout_s)
        return {"received": self._received, "ended": self._ended or time.monotonic()}

    def ask(self, seconds: float) -> dict[str, Any]:
        """Be asked to mark each message and to note what comes, for so long."""
        asked = trace.encode_request(TraceRequest(put=PREFIX, every=1, seconds=seconds))
        self._call(lambda: self.mesh.tracing.answer(asked))
        return {}

    def end(self) -> dict[str, Any]:
        """Nobody asks any more."""
        self._call(lambda: self.mesh.tracing.end(float("inf")))
        return {"wanted": len(self.mesh.tracing.wanted)}

    def look(self) -> dict[str, Any]:
        """How many seconds it takes to see that a message is not to be traced, where it is put and where it comes."""
        tracing = self.mesh.tracing
        names = {"wanted": tracing.wanted, "looks": tracing.looks}
        looked = min(timeit.repeat("if wanted: pass\nif looks: pass", globals=names, number=LOOKS, repeat=5))
        return {"took": looked / LOOKS}


def main() -> int:
    """Serve the run."""
    kind, port, every = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    ends = Ends(port, every)
    if kind == "take":
        ends.subscribe()
    works = {each.__name__: each for each in (ends.put, ends.expect, ends.receive, ends.ask, ends.end, ends.look)}
    serve({"kind": kind}, works)
    ends._run(ends.mesh.close())
    return 0


if __name__ == "__main__":
    sys.exit(main())
