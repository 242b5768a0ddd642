"""Watchers of tokens hear of each, whichever of Zenoh's threads brings it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
import zenoh

from macs_zenoh.mesh import Mesh, token_news
from macs_zenoh.protocol.keyexpr import LEASE
from tests.support.local import patient
from tests.support.waiting import until


class Token:
    """What Zenoh gives to a watcher."""

    kind = zenoh.SampleKind.PUT

    def __init__(self, key: str) -> None:
        self.key_expr = key


async def test_two_threads_bring_one_each_in_the_same_moment(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both are told, and so is what comes later: none of the two threads leaves it to the other to wake the loop."""
    met = threading.Barrier(2)

    class Meeting(deque[Any]):
        """In which each has put its own before any of them looks; where that cannot be, it goes on alone."""

        def append(self, item: Any) -> None:
            super().append(item)
            with suppress(threading.BrokenBarrierError):
                met.wait(0.5)

    told: set[str] = set()
    receives: list[Callable[[Token], None]] = []
    called = zenoh.handlers.Callback

    def callback(receive: Any, **arguments: Any) -> Any:
        receives.append(receive)
        return called(receive, **arguments)

    async with await Mesh.open(patient(router)) as mesh:
        monkeypatch.setattr(token_news, "deque", Meeting)
        monkeypatch.setattr(zenoh.handlers, "Callback", callback)
        watching = mesh.watch_tokens(LEASE.every(), lambda key, alive: told.add(key))
        monkeypatch.undo()
        (receive,) = receives
        threads = [threading.Thread(target=receive, args=(Token(key),)) for key in ("one", "other")]
        for thread in threads:
            thread.start()
        await until(lambda: told == {"one", "other"})
        token = mesh.declare_token(LEASE.of(block=9, zid="later"))
        await until(lambda: len(told) == 3)
        for thread in threads:
            thread.join()
        token.close()
        watching.close()
