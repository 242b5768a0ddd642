"""Tokens on several gateways, with a file that cannot be used for a while, and with clocks that are set."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.tokens import store
from macs_zenoh.errors import MacsError
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_pairing, new_secret
from tests.support.given import StartGateway
from tests.support.waiting import PATIENCE_S, until

NOBODY = {"plain_without_token": "nobody"}


def make(path: Path, name: str, expires_at: float | None = None) -> str:
    """A token; its secret."""
    secret = new_secret(os.urandom(32))
    token = Token(name=name, rights=Rights(may=["see"]), hashes=[hash_of(secret)], expires_at=expires_at)
    store.change(path, lambda tokens: (tokens.with_token(token), None))
    return secret


async def come(gateway: Gateway, secret: str) -> Headset:
    return await Headset.connect("127.0.0.1", gateway.port, token=secret)


async def test_a_token_ends_on_every_gateway_that_has_the_file(start_gateway: StartGateway, tmp_path: Path) -> None:
    """Two read one file, a third has a copy of it, as on another host: revoked, it ends on the two within a second,
    and on the third when the copy is there; others stay."""
    path, copy = tmp_path / "a" / "tokens.json", tmp_path / "b" / "tokens.json"
    lost, kept = make(path, "lost"), make(path, "kept")

    def copied() -> None:
        copy.parent.mkdir(mode=0o700, exist_ok=True)
        new = copy.with_suffix(".new")
        new.touch(0o600)
        new.write_bytes(path.read_bytes())
        new.rename(copy)

    copied()
    one, two = [await start_gateway(tokens_file=str(path), **NOBODY) for _ in range(2)]
    three = await start_gateway(tokens_file=str(copy), **NOBODY)
    async with AsyncExitStack() as stack:

        async def enter(gateway: Gateway, secret: str) -> Headset:
            return await stack.enter_async_context(await come(gateway, secret))

        ends = [await enter(gateway, lost) for gateway in (one, two)]
        elsewhere = await enter(three, lost)
        stays = [await enter(gateway, kept) for gateway in (one, two, three)]
        began = time.monotonic()
        store.change(path, lambda tokens: (tokens.without("lost"), None))
        why = {await asyncio.wait_for(headset.wait_ended(), PATIENCE_S) for headset in ends}
        print(f"ended on two gateways after {time.monotonic() - began:.2f} s")
        assert why == {"this token holds no longer"}
        await elsewhere.online()
        copied()
        assert await asyncio.wait_for(elsewhere.wait_ended(), PATIENCE_S) == "this token holds no longer"
        for headset in stays:
            await headset.online()
        for gateway in (one, two, three):
            with pytest.raises(MacsError, match="a valid token is wanted here"):
                await come(gateway, lost)


def half(path: Path) -> None:
    """As who writes it in place leaves it for a moment, or for good."""
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def open_to_others(path: Path) -> None:
    path.chmod(0o666)


def a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def something_else(path: Path) -> None:
    path.write_text("[1, 2, 3]")


def empty(path: Path) -> None:
    path.write_text("")


@pytest.mark.parametrize(
    "spoil", [half, open_to_others, a_folder, something_else, empty], ids=lambda each: each.__name__
)
async def test_a_file_that_cannot_be_used_changes_nothing(
    start_gateway: StartGateway, tmp_path: Path, caplog: pytest.LogCaptureFixture, spoil: Callable[[Path], None]
) -> None:
    """Who is inside stays, who has a token comes in, who has none does not, and it is said once; when the file is
    right again, what it says holds."""
    path = tmp_path / "site" / "tokens.json"
    secret = make(path, "anna")
    gateway = await start_gateway(tokens_file=str(path), **NOBODY)
    async with await come(gateway, secret) as inside:
        good = path.read_bytes()
        spoil(path)
        await until(lambda: [each for each in caplog.messages if each.startswith("tokens stay as they were")])
        async with await come(gateway, secret) as other:
            await other.online()
        for wrong in ("macs_wrong", secret[:-1]):
            with pytest.raises(MacsError, match="a valid token is wanted here"):
                await come(gateway, wrong)
        await inside.online()
        assert len([each for each in caplog.messages if each.startswith("tokens stay as they were")]) == 1
        if path.is_dir():
            path.rmdir()
        path.write_bytes(good)
        path.chmod(0o600)
        store.change(path, lambda tokens: (tokens.without("anna"), None))
        assert await asyncio.wait_for(inside.wait_ended(), PATIENCE_S) == "this token holds no longer"


async def test_a_file_that_is_gone_ends_all_tokens(start_gateway: StartGateway, tmp_path: Path) -> None:
    """Whoever takes it away wants nobody in."""
    path = tmp_path / "site" / "tokens.json"
    secret = make(path, "anna")
    gateway = await start_gateway(tokens_file=str(path), **NOBODY)
    async with await come(gateway, secret) as inside:
        path.unlink()
        assert await asyncio.wait_for(inside.wait_ended(), PATIENCE_S) == "this token holds no longer"
        with pytest.raises(MacsError, match="a valid token is wanted here"):
            await come(gateway, secret)


class Clock:
    """The time of day as a gateway sees it, which somebody sets; intervals go on as ever."""

    def __init__(self) -> None:
        self.ahead_s = 0.0
        self.monotonic = time.monotonic

    def time(self) -> float:
        return time.time() + self.ahead_s


async def test_clocks_that_are_set(
    start_gateway: StartGateway, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that is set forward past a token's end ends it and its connections; set back, it holds again, as what it
    says is a time of day; one without an end does not care. A code is good for two minutes of that clock, and for
    five tries of any."""
    clock = Clock()
    monkeypatch.setattr("bridge.gateway.door.time", clock)
    path = tmp_path / "site" / "tokens.json"
    hour, ever = make(path, "hour", time.time() + 3600), make(path, "ever")
    gateway = await start_gateway(tokens_file=str(path), **NOBODY)
    async with await come(gateway, hour) as ends, await come(gateway, ever) as stays:
        clock.ahead_s = 3601
        assert await asyncio.wait_for(ends.wait_ended(), PATIENCE_S) == "this token holds no longer"
        with pytest.raises(MacsError, match="a valid token is wanted here"):
            await come(gateway, hour)
        clock.ahead_s = -86_400 * 365
        async with await come(gateway, hour) as again:
            await again.online()
        await stays.online()
    clock.ahead_s = 0
    store.change(
        path,
        lambda now: (now.with_pairing(new_pairing("ever", "123456", os.urandom(32), time.time()), time.time()), None),
    )
    clock.ahead_s = 121
    assert await gateway._door.exchange("123456") is None
    clock.ahead_s = 0
    for _ in range(5):
        assert await gateway._door.exchange("000000") is None
    assert await gateway._door.exchange("123456") is None
