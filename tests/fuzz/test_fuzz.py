"""The fuzz target itself: it runs, it finds what is planted, and a short run finds nothing."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.messages import Metadata
from tests.fuzz import decoder


@pytest.mark.parametrize("seed", range(2))
def test_a_short_run_finds_nothing(seed: int) -> None:
    """The same few hundred changed recordings, in every run, give frames, events or a WireError."""
    found = decoder.run(seed, rounds=300)
    if isinstance(found, decoder.Found):
        pytest.fail(f"{found.problem!r}: python -m tests.fuzz.decoder --seed {seed} finds and shrinks it")
    assert found == 300


def test_a_planted_bug_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """An exception that is no WireError ends the run with the input that caused it."""

    def fail(data: bytes) -> Metadata:
        raise ZeroDivisionError

    monkeypatch.setattr(decoder.Metadata, "decode", fail)
    found = decoder.run(0, rounds=50)
    assert isinstance(found, decoder.Found)
    assert isinstance(found.problem, ZeroDivisionError)
    smaller = decoder.shrink(found, seconds=0.5)
    assert isinstance(smaller.problem, ZeroDivisionError)
    assert len(smaller.data) < len(found.data)
