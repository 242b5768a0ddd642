"""Watchers of tokens hear of each, whichever of Zenoh's threads brings it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
import zenoh

from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh, token_news
from macs_zenoh.presence import Presence
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import LEASE
from macs_zenoh.protocol.messages import UNITY
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until


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


async def test_of_many_that_come_together_each_is_told_once(router: str) -> None:
    """And those that end as well; in the first moments of a watcher in any order."""
    many, told = 500, list[tuple[str, bool]]()
    async with await Mesh.open(patient(router)) as mesh, await Mesh.open(patient(router)) as other:
        keys = [LEASE.of(block=number % 256, zid=str(number)) for number in range(many)]
        watching = mesh.watch_tokens(LEASE.every(), lambda key, alive: told.append((key, alive)))
        tokens = [other.declare_token(key) for key in keys]
        await until(lambda: len(told) == many)
        for token in tokens:
            token.close()
        await until(lambda: len(told) == 2 * many)
        watching.close()
    assert sorted(told[:many]) == sorted((key, True) for key in keys)
    assert sorted(told[many:]) == sorted((key, False) for key in keys)


async def test_what_an_agent_asks_comes_behind_its_presence(router: str) -> None:
    """A robot forgets what was registered under an id when another has it: news that came late would undo what that
    one has registered already."""
    async with await Mesh.open(patient(router)) as mesh, await Mesh.open(patient(router)) as other:
        presence = Presence(mesh, lambda changes: None, lambda contested: None)
        await presence.start()

        async def answer(key: str, _payload: bytes) -> bytes:
            return b"seen" if (UNITY, int(key.rpartition("/")[2])) in presence.directory else b"not seen"

        serving = mesh.serve("asked/*", answer)
        await until(lambda: _served(other))
        tokens = []
        for number in range(2, 200):
            tokens.append(other.declare_token(AgentInfo(UNITY, number, 0, other.zid).presence))
            assert await other.query(f"asked/{number}", b"", timeout_s=PATIENCE_S) == b"seen"
        presence.close()
        serving.close()


async def _served(mesh: Mesh) -> bool:
    """Whether the router knows who answers."""
    try:
        return bool(await mesh.query("asked/1", b"", timeout_s=1))
    except MacsError:
        return False
