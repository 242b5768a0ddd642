"""Claims of sessions that somebody makes up have an end, and it is known when there is room again."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.room import Room

SESSIONS, EACH, TOTAL = 2, 4, 12

steps = st.lists(st.tuples(st.booleans(), st.sampled_from("xyz"), st.sampled_from("abcdefgm")), max_size=80)


@given(steps)
def test_room_is_made_for_whatever_was_left_out(told: list[tuple[bool, str, str]]) -> None:
    """After any tokens the bounds hold but for one's own; and once those that are left out are told again whenever
    room is made, those that count are as many as there is room for."""
    room: Room[str] = Room("m", sessions=SESSIONS, each=EACH, total=TOTAL)
    tokens: set[tuple[str, str]] = set()
    held: dict[str, set[str]] = {"x": set(), "y": set(), "z": set()}

    def take(what: str, zid: str) -> None:
        if zid not in held[what]:
            out = room.take(what, zid, held[what])
            held[what].add(zid)
            held[what].discard(out or "")

    for alive, what, zid in told:
        (tokens.add if alive else tokens.discard)((what, zid))
        if alive:
            take(what, zid)
        elif zid in held[what]:
            held[what].remove(zid)
            room.release(what, zid)
        if room.is_made():
            for token in sorted(tokens):
                take(*token)
    for what, zids in held.items():
        there = {zid for other, zid in tokens if other == what}
        assert zids <= there
        assert ("m" in zids) == ("m" in there)
        others = sorted(there - {"m"})
        assert len(zids - {"m"}) <= SESSIONS
        assert len(zids) >= min(SESSIONS, len(there))
        if len(others) >= SESSIONS and "m" not in there:
            assert others[0] in zids


def test_what_is_full_leaves_room_for_who_has_little() -> None:
    """One session has its share, and several that take much leave a quarter to others; what always counts does."""
    room: Room[int] = Room("m", sessions=2, each=32, total=64)
    taken = {zid: sum(room.take(what, zid, ()) is None for what in range(40)) for zid in ("a", "b")}
    assert taken == {"a": 32, "b": 16}
    assert room.take(1, "c", ()) is None
    assert room.take(50, "b", ()) == "b"
    assert room.take(50, "b", (), always=True) is None
    assert room.take(51, "m", ()) is None
    assert room.left_out == 8 + 24 + 1
    assert not room.is_made()
    room.release(1, "c")
    assert room.is_made()
