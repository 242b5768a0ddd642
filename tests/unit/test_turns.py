"""Whoever wants much makes nobody else wait."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.turns import Turns

ONE, TWO = (2, 1), (2, 2)


def test_callers_take_turns() -> None:
    """Of what waits the callers' calls are made in turn, each one's in its order."""
    turns: Turns[str, int] = Turns(each=10, total=10)
    for number in range(3):
        turns.put(ONE, f"a{number}", number)
    turns.put(TWO, "b", 7)
    assert [turns.take() for _ in range(5)] == [(ONE, "a0", 0), (TWO, "b", 7), (ONE, "a1", 1), (ONE, "a2", 2), None]


def test_so_many_are_open() -> None:
    """Of one caller, and of all, only so many calls are open at one time."""
    turns: Turns[int, int] = Turns(each=2, total=3)
    for number in range(5):
        turns.put(ONE, number, number)
        turns.put(TWO, number, number)
    assert [turn[0] for _ in range(4) if (turn := turns.take())] == [ONE, TWO, ONE]
    turns.done(TWO)
    assert turns.take() == (TWO, 1, 1)
    turns.done(ONE)
    turns.drop(TWO)
    assert turns.take() == (ONE, 2, 2)
    turns.done(TWO)
    assert turns.take() is None


def test_the_newer_call_counts() -> None:
    """A call with the same key replaces the one that waits; a dropped one is not made."""
    turns: Turns[str, int] = Turns(each=9, total=9)
    turns.put(ONE, "a", 1)
    turns.put(ONE, "b", 2)
    turns.put(ONE, "a", 3)
    turns.drop(ONE, "b")
    turns.drop(TWO, "b")
    assert turns.take() == (ONE, "a", 3)
    assert turns.take() is None


@given(st.lists(st.tuples(st.sampled_from(["put", "take", "done"]), st.integers(1, 4)), max_size=100))
def test_bounds_hold(story: list[tuple[str, int]]) -> None:
    """Whatever happens, the bounds hold, and nobody waits while there is room for it."""
    turns: Turns[int, int] = Turns(each=2, total=5)
    opened: list[tuple[int, int]] = []
    for number, (what, caller) in enumerate(story):
        if what == "put":
            turns.put((2, caller), number, number)
        elif what == "done" and opened:
            turns.done(opened.pop(0))
        elif what == "take":
            turn = turns.take()
            if turn is not None:
                opened.append(turn[0])
            else:
                waiting = [c for c in ((2, i) for i in range(1, 5)) if turns.waits(c)]
                assert len(opened) == 5 or all(opened.count(c) == 2 for c in waiting)
        assert turns.open == len(opened) <= 5
        assert all(opened.count((2, i)) <= 2 for i in range(1, 5))
