"""Watchers of tokens hear of each, and hold up nothing else that comes over their link."""

from __future__ import annotations

import asyncio
import sys
import threading

from macs_zenoh.mesh import Mesh
from macs_zenoh.mesh.token_news import TokenChange, watch
from macs_zenoh.protocol.keyexpr import LEASE
from tests.support.local import patient
from tests.support.programs import finished
from tests.support.waiting import first_of, until

MANY = 500


async def test_many_that_come_together_are_told_of_in_their_order(router: str) -> None:
    """And those that end as well; nothing is told twice."""
    told: list[tuple[str, bool]] = []
    async with await Mesh.open(patient(router)) as mesh, await Mesh.open(patient(router)) as other:
        keys = [LEASE.of(block=number % 256, zid=str(number)) for number in range(MANY)]
        watching = mesh.watch_tokens(LEASE.every(), lambda key, alive: told.append((key, alive)))
        tokens = [other.declare_token(key) for key in keys]
        await until(lambda: len(told) == MANY)
        for token in tokens:
            token.close()
        await until(lambda: len(told) == 2 * MANY)
        watching.close()
    assert told == [(key, True) for key in keys] + [(key, False) for key in keys]


async def test_who_is_told_of_tokens_holds_up_no_message(router: str) -> None:
    """A message comes over the same link while a watcher is busy with a token that came before it."""
    busy, came = threading.Event(), threading.Event()
    heard: list[bool] = []

    def told(_tokens: list[TokenChange]) -> None:
        busy.set()
        heard.append(came.wait(10))

    async with await Mesh.open(patient(router)) as mesh, await Mesh.open(patient(router)) as other:
        watching = watch(mesh._session.liveliness(), LEASE.every(), told)
        messages: asyncio.Queue[bytes] = asyncio.Queue()
        listening = mesh.subscribe("a/b", lambda batch: [messages.put_nowait(bytes(item[1])) for item in batch])
        token = other.declare_token(LEASE.of(block=9, zid="other"))
        await until(busy.is_set)
        await first_of(messages.get(), lambda: other.put("a/b", b"a command"))
        came.set()
        await until(lambda: bool(heard))
        for each in (token, listening, watching):
            each.close()
    assert heard[0]


LEFT_OPEN = """
import sys
import zenoh
from macs_zenoh.mesh.token_news import watch
from macs_zenoh.mesh.zenoh_config import zenoh_config
from tests.support.local import patient

session = zenoh.open(zenoh_config(patient(sys.argv[1])))
watching = watch(session.liveliness(), "some/**", print)
"""


async def test_a_program_that_closes_nothing_ends_properly(router: str) -> None:
    """Python ends its threads, and this one must not be in Zenoh then: that would abort the program."""
    code, _, err = await finished(sys.executable, "-c", LEFT_OPEN, router)
    assert code == 0, err
