"""What was said and may not have arrived: both ends of a session, over connections that are cut at any place."""

from __future__ import annotations

from collections import deque

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.kept import Kept, Room

steps = st.lists(st.sampled_from(["call", "call", "topic", "takes", "takes", "tells", "cut"]), min_size=1, max_size=80)


@given(steps)
def test_all_that_is_kept_arrives_once_and_in_order(happens: list[str]) -> None:
    """However often and wherever the connection is cut, the other end gets each call once, in order; topics that were
    on their way are lost, and none comes twice."""
    kept: Kept[str] = Kept(1 << 20, 1000)
    wire: deque[str] = deque()
    said: list[str] = []
    got: list[str] = []
    received = 0

    def cut() -> None:
        wire.clear()
        again, missing = kept.again(received)
        assert not missing
        for each in again:
            kept.put(each, 1)
            wire.append(each)

    for number, what in enumerate(happens):
        text = f"{what} {number}"
        if what == "call":
            kept.put(text, 1)
            wire.append(text)
            said.append(text)
        elif what == "topic":
            kept.skip()
            wire.append(text)
        elif what == "takes" and wire:
            got.append(wire.popleft())
            received += 1
        elif what == "tells":
            kept.arrived(received)
        elif what == "cut":
            cut()
    cut()
    got += wire
    assert [each for each in got if each.startswith("call")] == said
    assert len(set(got)) == len(got)


def test_what_has_no_room_gives_way_and_that_is_known() -> None:
    """The oldest go first, by bytes and by number; whether one of them was missed is told, and only then."""
    kept: Kept[int] = Kept(100, 3)
    for number in range(1, 6):
        kept.put(number, 10)
    assert len(kept) == 3
    assert kept.again(2) == ([3, 4, 5], False)
    for number in range(3, 6):
        kept.put(number, 10)
    kept.put(6, 95)
    assert kept.again(5) == ([6], False)
    kept.put(6, 95)
    kept.put(7, 101)  # larger than all may have
    assert kept.bytes == 0
    assert kept.again(5) == ([], True)
    assert kept.number == 5


def test_who_says_that_he_has_more_than_was_said_gets_nothing_twice() -> None:
    """A number from the other end is believed as far as there is something behind it."""
    kept: Kept[int] = Kept(100, 10)
    kept.put(1, 1)
    kept.arrived(1 << 62)
    assert kept.again(1 << 62) == ([], False)
    assert kept.number == 1


def test_all_together_have_so_much_room() -> None:
    """Who keeps little is left what he has; who keeps much gives way, and what is given up is not counted."""
    room = Room(100_000)
    little, much = Kept[int](1 << 20, 1000, room), Kept[int](1 << 20, 1000, room)
    for number in range(10):
        little.put(number, 1000)
    for number in range(1000):
        much.put(number, 1000)
        assert room.bytes == little.bytes + much.bytes <= 100_000
    assert len(little) == 10
    much.clear()
    little.clear()
    assert room.bytes == 0
