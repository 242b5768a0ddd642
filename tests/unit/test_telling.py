"""Who asks a robot for definitions: one after the other, and only so many wait."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterable
from typing import cast

import pytest

pytest.importorskip("rclpy", reason="what a robot tells needs ROS")

from bridge.ros.definitions import Definitions, Telling
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.schemas import DefinitionsReply


class Slow:
    """Takes as long as reading files, and knows how many threads do that."""

    def __init__(self) -> None:
        self.at_once = self.most = self.told = 0
        self._lock = threading.Lock()

    def tell(self, names: Iterable[str]) -> DefinitionsReply:
        with self._lock:
            self.at_once += 1
            self.most = max(self.most, self.at_once)
        time.sleep(0.001)
        with self._lock:
            self.at_once -= 1
            self.told += 1
        return DefinitionsReply()


async def test_one_thread_reads_at_a_time_and_a_flood_is_refused() -> None:
    """Of a thousand questions of one sender so many are answered as may wait, and another one's is."""
    slow = Slow()
    telling = Telling(cast(Definitions, slow))
    flood = [asyncio.create_task(telling.tell("flooder", ["a/msg/A"])) for _ in range(1000)]
    await asyncio.sleep(0)
    assert isinstance(await telling.tell("other", ["a/msg/A"]), DefinitionsReply)
    outcomes = await asyncio.gather(*flood, return_exceptions=True)
    assert sum(isinstance(outcome, DefinitionsReply) for outcome in outcomes) == Telling.EACH
    assert sum(isinstance(outcome, Refused) for outcome in outcomes) == 1000 - Telling.EACH
    assert (slow.most, slow.told) == (1, Telling.EACH + 1)
    assert isinstance(await telling.tell("flooder", ["a/msg/A"]), DefinitionsReply)
