"""Secrets of sessions: each finds its own holder, and nothing else finds anybody."""

from __future__ import annotations

import os

from macs_zenoh.protocol.sessions import SECRET_BYTES, Sessions, new_secret


def test_a_secret_finds_its_holder_until_it_is_closed() -> None:
    """A cut-off, changed or foreign one finds nobody, as does one that was given up."""
    sessions: Sessions[str] = Sessions()
    one, two, other = (new_secret(os.urandom(SECRET_BYTES)) for _ in range(3))
    sessions.open(one, "one")
    sessions.open(two, "two")
    assert (sessions.find(one), sessions.find(two)) == ("one", "two")
    for wrong in (other, "", one[:-1], one + "x", one.swapcase(), "x" * 10_000, "\ud800"):
        assert sessions.find(wrong) is None
    sessions.open(other, "one")
    assert sessions.find(one) is None
    assert sessions.find(other) == "one"
    assert len(sessions) == 2
    sessions.close("one")
    sessions.close("one")
    assert sessions.find(other) is None
    assert "two" in sessions
