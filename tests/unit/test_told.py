"""The state of a robot, as many ask for it: put together anew for each, but not for each of a flood."""

from __future__ import annotations

from itertools import count

import pytest

pytest.importorskip("rclpy", reason="what a robot tells needs ROS")

from bridge.ros.requests import FRESH_PER_S, GOOD_S, Told


def test_who_asks_now_and_then_is_told_how_it_is_now() -> None:
    """Also twice in one moment."""
    number = count()
    told = Told(lambda: b"%d" % next(number))
    assert [told.now(at) for at in (0.0, 0.0, 1.0, 1.001)] == [b"0", b"1", b"2", b"3"]


def test_a_flood_is_told_what_was_a_moment_ago() -> None:
    """Never what was longer ago, and then as it is again."""
    number, asked = count(), 10_000
    told = Told(lambda: b"%d" % next(number))
    made_at: dict[bytes, float] = {}
    for each in range(asked):
        now = 5.0 + each / asked  # in one second
        assert now - made_at.setdefault(told.now(now), now) <= GOOD_S
    assert len(made_at) <= 2 * FRESH_PER_S + 1 / GOOD_S
    assert told.now(100.0) not in made_at
