"""What all have together, those at one address, and each, stays within bounds; who has little can have some."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.budget import Budget, Ever, Toll, Unfinished


def test_each_address_and_all_have_bounds() -> None:
    """The reason says which bound is reached."""
    budget = Budget("nodes", each=32, per_address=40, total=64)
    assert budget.judge("a", "here", 32) is None
    assert budget.judge("a", "here", 33) == "each may have 32 nodes"
    budget.set("a", "here", 32)
    assert budget.judge("b", "here", 9) == "all at one address may have 40 nodes"
    assert budget.judge("b", "there", 16) is None
    budget.set("b", "there", 16)
    assert budget.judge("c", "elsewhere", 3) == "all together may have 64 nodes"


def test_the_last_quarter_is_for_those_who_have_little() -> None:
    """Whoever takes much cannot take what others need to begin with; and what is given back is there again."""
    budget = Budget("nodes", each=32, per_address=1000, total=64)
    budget.set("a", "x", 32)
    budget.set("b", "y", 16)
    assert budget.judge("b", "y") is not None
    assert budget.judge("c", "z", 2) is None
    budget.set("a", "x", 0)
    assert (budget.used, budget.of("a"), budget.of("b")) == (16, 0, 16)
    assert budget.judge("b", "y", 16) is None


@given(st.lists(st.tuples(st.integers(1, 4), st.integers(1, 40)), max_size=200))
def test_what_somebody_had_once_he_may_have_again(story: list[tuple[int, int]]) -> None:
    """Of different things each has at most so many, and all so many; the same one again costs nothing."""
    ever = Ever(each=16, total=20)
    had: dict[int, set[int]] = {holder: set() for holder in range(1, 5)}
    for holder, what in story:
        before = what in had[holder]
        if ever.may(holder, what):
            had[holder].add(what)
        else:
            assert not before
    assert max(len(his) for his in had.values()) <= 16
    assert ever.used == sum(len(his) for his in had.values()) <= 20
    room = ever.used < 20
    assert ever.may("somebody else", 1) == room


@given(st.lists(st.tuples(st.integers(1, 5), st.integers(0, 20)), max_size=60))
def test_who_asks_first_stays_within_bounds(story: list[tuple[int, int]]) -> None:
    """As long as holders ask before they take more, no bound is exceeded."""
    budget = Budget("bytes", each=16, per_address=20, total=30)
    has: dict[int, int] = {}
    for holder, amount in story:
        address = f"address {holder % 2}"
        if amount < has.get(holder, 0) or budget.judge(holder, address, amount - has.get(holder, 0)) is None:
            budget.set(holder, address, amount)
            has[holder] = amount
        assert budget.used == sum(has.values()) <= 30
        assert sum(amount for who, amount in has.items() if who % 2) <= 20
        assert budget.of(holder) == has.get(holder, 0) <= 16


def test_work_beyond_a_seconds_worth_is_paid_with_time() -> None:
    """So much is free at once; beyond that it is as much per second as said, with pauses that nobody minds."""
    toll = Toll(per_s=100)
    assert [toll.pay(50.0) for _ in range(100)] == [0.0] * 100
    now, done = 50.0, 0
    while now < 60.0:
        hold_s = toll.pay(now)
        assert 0 < hold_s <= Toll.LONGEST_S
        now += hold_s
        done += 1
    assert 950 <= done <= 1050
    assert toll.pay(70.0) == 0.0
    assert toll.pay(80.0, 100) == 0.0
    assert 0.04 < toll.pay(80.0, 5) < 0.06, "as five by themselves"


def test_of_unfinished_frames_the_oldest_goes() -> None:
    """When frames that have begun take too much together, the one that began first is the one that has to go; those
    that end, and small ones, are no trouble."""
    unfinished: Unfinished[str] = Unfinished(free=10, total=100)
    assert unfinished.note("slow", "here", 50) == []
    for _ in range(100):
        assert unfinished.note("quick", "here", 40) == []
        assert unfinished.note("quick", "here", 0) == []
        assert unfinished.note("small", "here", 10) == []
    assert unfinished.used == 50
    assert unfinished.note("quick", "here", 30) == []
    assert unfinished.note("quick", "here", 60) == ["slow"]
    assert unfinished.note("other", "here", 50) == ["quick"]
    assert unfinished.note("other", "here", 30) == []
    assert unfinished.note("other", "here", 101) == ["other"]
    assert unfinished.used == 0
    assert "other" not in unfinished


def test_unfinished_frames_of_one_address_cost_nobody_elsewhere_his_own() -> None:
    """One that began before all of them and comes slowly, from another address, goes on."""
    unfinished: Unfinished[str] = Unfinished(free=10, total=100)
    assert unfinished.note("slow", "there", 20) == []
    gone = [each for number in range(50) for each in unfinished.note(f"flood {number}", "here", 30)]
    assert gone == [f"flood {number}" for number in range(48)]
    assert unfinished.note("slow", "there", 40) == []
    assert unfinished.note("slow", "there", 50) == ["flood 48"]
    assert unfinished.note("flood 49", "here", 0) == []
    assert unfinished.note("slow", "there", 0) == []
    assert unfinished.used == 0
