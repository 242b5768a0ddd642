"""`macs_zenoh.mesh.gathered`: when a token is declared that others come with."""

from __future__ import annotations

import pytest

from macs_zenoh.mesh import GatheredTokens, Token, gathered
from tests.support.waiting import until


class Declared:
    """In Zenoh's place: notes what is declared and undeclared."""

    def __init__(self) -> None:
        self.now: list[str] = []

    def declare(self, key: str) -> Token:
        """A token that is there at once."""
        self.now.append(key)
        return Token(_There(self.now, key))


class _There:
    def __init__(self, now: list[str], key: str) -> None:
        self._now, self._key = now, key

    def undeclare(self) -> None:
        self._now.remove(self._key)


async def test_the_first_is_declared_at_once_and_others_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who comes alone does not wait; those behind it are declared in their order, all at one time."""
    zenoh = Declared()
    tokens = GatheredTokens(zenoh.declare)
    kept = [tokens.declare("a")]
    assert zenoh.now == ["a"]
    kept += [tokens.declare(key) for key in "bcd"]
    assert (zenoh.now, len(tokens)) == (["a"], 3)
    await until(lambda: zenoh.now == ["a", "b", "c", "d"])
    assert len(tokens) == 0
    for token in kept:
        token.close()
    assert zenoh.now == []
    monkeypatch.setattr(gathered, "GATHER_S", 60.0)
    await until(lambda: tokens._gathering is None)  # for a while nobody has come
    kept.append(tokens.declare("e"))
    assert zenoh.now == ["e"]
    tokens.close()


async def test_who_is_gone_before_is_never_declared(monkeypatch: pytest.MonkeyPatch) -> None:
    """A token that is closed while it waits; the same key afterwards is another one, and there."""
    monkeypatch.setattr(gathered, "GATHER_S", 60.0)
    zenoh = Declared()
    tokens = GatheredTokens(zenoh.declare)
    first = tokens.declare("a")
    tokens.declare("b").close()
    second = tokens.declare("b")
    tokens.declare_now(second)
    assert zenoh.now == ["a", "b"]
    second.close()
    first.close()
    assert zenoh.now == []
    tokens.close()


async def test_one_that_cannot_be_declared_costs_itself(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It is logged, and those behind it are there."""
    monkeypatch.setattr(gathered, "GATHER_S", 60.0)
    zenoh = Declared()

    def declare(key: str) -> Token:
        if key == "b":
            raise RuntimeError("no")
        return zenoh.declare(key)

    tokens = GatheredTokens(declare)
    kept = [tokens.declare(key) for key in "abc"]
    for token in kept:
        tokens.declare_now(token)
    assert zenoh.now == ["a", "c"]
    assert "b cannot be declared" in caplog.text
    for token in kept:
        token.close()
    assert zenoh.now == []
    tokens.close()


async def test_of_many_only_some_are_declared_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A router takes its time for each, and commands wait behind them. Who says something is there before its turn,
    who has gone takes nobody's."""
    zenoh = Declared()
    tokens = GatheredTokens(zenoh.declare)
    keys = [str(number) for number in range(30)]
    kept = dict(zip(keys, [tokens.declare(key) for key in keys], strict=True))
    tokens.declare_now(kept["20"])
    assert zenoh.now == ["0", "20"]
    for key in keys[1:4]:
        kept.pop(key).close()
    sizes = {len(zenoh.now)}

    def all_there() -> bool:
        sizes.add(len(zenoh.now))
        return sizes >= {27}

    await until(all_there, every_s=0.001)
    assert sizes <= {2, *range(2, 27, gathered.AT_ONCE), 27}
    assert zenoh.now == ["0", "20", *keys[4:20], *keys[21:]]
    assert not len(tokens)
    tokens.close()
