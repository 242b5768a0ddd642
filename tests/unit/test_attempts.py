"""Attempts to come in without a token, counted."""

from __future__ import annotations

from macs_zenoh.protocol.attempts import ADDRESSES, EVERY_S, Attempts


def test_attempts_are_told_now_and_then_in_bounded_memory() -> None:
    """The first of an address is told, then once a minute with their number; of addresses so many are kept."""
    attempts = Attempts()
    assert [attempts.note("a", float(number)) for number in range(3)] == [1, 0, 0]
    assert attempts.note("a", EVERY_S) == 4
    for number in range(10 * ADDRESSES):
        assert attempts.note(f"b{number}", EVERY_S) == 1
    assert len(attempts) == ADDRESSES
