"""Handles end what they stand for, once, and callbacks may end each other."""

from __future__ import annotations

from macs_zenoh.handles import Callbacks, Handle


def test_a_handle_ends_once() -> None:
    """Closed twice, or by a block and by hand, it ends what it stands for once."""
    ended: list[str] = []
    with Handle(lambda: ended.append("it")) as handle:
        assert handle.is_open
        handle.close()
        assert not handle.is_open
    handle.close()
    assert ended == ["it"]


def test_callbacks_are_told_in_their_order_each_as_often_as_it_came() -> None:
    """Who asked twice is told twice, and ends one of the two with one handle."""
    callbacks: Callbacks[str] = Callbacks()
    assert not callbacks
    first, _ = callbacks.add("a"), callbacks.add("b")
    callbacks.add("a")
    assert list(callbacks) == ["a", "b", "a"]
    first.close()
    assert list(callbacks) == ["b", "a"]


def test_one_that_was_closed_while_others_are_told_is_left_out() -> None:
    """A callback that ends a later one keeps it from being told; one that comes meanwhile is told the next time."""
    callbacks: Callbacks[str] = Callbacks()
    callbacks.add("a")
    second = callbacks.add("b")
    told = []
    for name in callbacks:
        told.append(name)
        second.close()
        callbacks.add("c")
    assert told == ["a"]
    assert list(callbacks) == ["a", "c"]
