"""What a TCP agent sends to robots has a limit, and of what waited in its connection only the newest counts."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.rate_limit import (
    FLOODED,
    NOW,
    SINGLE_BYTES,
    TOGETHER,
    TOO_OLD,
    WAITED,
    Pace,
    Passing,
    together,
)
from macs_zenoh.protocol.recency import Recency

MOVE, ARM = "move", "arm"


@pytest.fixture
def pace() -> Pace:
    return Pace(100, 10, 0.0)


def drive(pace: Pace, begin: float, count: int, hz: float = 20) -> list[Passing]:
    return [pace.command(MOVE, 1, begin + number / hz) for number in range(count)]


def test_commands_and_requests_have_limits_of_their_own(pace: Pace) -> None:
    """A second's worth of each passes at once; using up one leaves the other."""
    assert [pace.request(1, 0.0) for _ in range(12)] == [NOW] * 10 + [FLOODED] * 2
    assert [pace.command(MOVE, 50, 0.0) for _ in range(3)] == [NOW] * 2 + [FLOODED]
    assert pace.request(5, 0.5) is NOW


def test_large_messages_count_as_several() -> None:
    """A second's worth of small ones is 16 KiB each of large ones; the largest passes, if not many of them do."""
    size, frames_per_s = 1 << 20, 2000
    each = size // SINGLE_BYTES
    for judge in (lambda pace, size: pace.command(MOVE, 1, 0.0, size), lambda pace, size: pace.request(1, 0.0, size)):
        pace = Pace(frames_per_s, frames_per_s, 0.0)
        assert [judge(pace, size) for _ in range(100)].count(NOW) == frames_per_s // each
        pace = Pace(frames_per_s, frames_per_s, 0.0)
        assert [judge(pace, 1 << 30) for _ in range(100)].count(NOW) == 2
        pace = Pace(frames_per_s, frames_per_s, 0.0)
        assert (
            frames_per_s - Pace.NEW_KIND < [judge(pace, SINGLE_BYTES) for _ in range(3000)].count(NOW) <= frames_per_s
        )


def test_small_messages_that_come_together_count_one_each() -> None:
    """However many bytes a run of them has."""
    pace = Pace(2000, 2000, 0.0)
    assert pace.command(MOVE, 2000, 0.0, 2000 * 300) is NOW
    assert pace.command(MOVE, 1, 0.0, 300) is FLOODED


def test_of_ever_new_kinds_few_pass() -> None:
    """Each makes robots look for a node; who has a hundred, one after the other, sends as much as others."""
    frames_per_s = 2000
    pace = Pace(frames_per_s, 0, 0.0)
    assert [pace.command(number, 1, 0.0) for number in range(4000)].count(NOW) == frames_per_s // Pace.NEW_KIND
    kinds = [number * 7919 % 2000 for number in range(8000)]
    assert [pace.command(kind, 1, 1 + number / 4000) for number, kind in enumerate(kinds)].count(NOW) < frames_per_s
    pace = Pace(frames_per_s, 0, 0.0)
    for number in range(100):
        assert pace.command(number, 1, 0.0) is NOW
    assert {pace.command(number % 100, 1, 1 + number / 1900) for number in range(10_000)} == {NOW}


def test_the_largest_passes_at_a_low_limit_too() -> None:
    """Of one a second, one a second."""
    pace = Pace(1, 1, 0.0)
    assert [pace.command(MOVE, 1, now, 1 << 30) for now in (0.0, 0.5, 1.0, 2.5)] == [NOW, FLOODED, NOW, NOW]


def test_many_who_send_all_that_one_may_share_what_a_few_may() -> None:
    """Twenty at their limit have no more together than four; who sends little passes whatever they do."""
    shared = Credit(TOGETHER * 100, 0.0)
    crowd = [Pace(0, 100, 0.0, shared) for _ in range(20)]
    modest, passed, little = Pace(0, 100, 0.0, shared), 0, 0
    for number in range(10_000):
        now = number / 1000
        passed += sum(pace.request(1, now) is NOW for pace in crowd)
        if number % 100 == 0:
            little += modest.request(1, now) is NOW
    at_first = 20 * 100 * (1 - Pace.LITTLE)
    assert passed <= TOGETHER * 100 * 11 + 2 * at_first
    assert little == 100


def test_many_that_begin_at_once_have_no_second_of_it_at_once() -> None:
    """Or the answers to all of it would come in one go; at the rate it goes on."""
    shared = together(100, 0.0)
    crowd = [Pace(0, 100, 0.0, shared) for _ in range(20)]

    def passed(now: float) -> int:
        return sum(pace.request(1, now) is NOW for _ in range(100) for pace in crowd)

    at_first = 20 * 100 * (1 - Pace.LITTLE)
    assert passed(0.0) == pytest.approx(at_first + 100, abs=20)
    assert sum(passed(tick / 100) for tick in range(1, 101)) == pytest.approx(TOGETHER * 100, rel=0.05)


def test_after_a_gap_in_a_flow_what_comes_together_has_waited(pace: Pace) -> None:
    """Ten seconds of nothing, then what was said meanwhile; what comes at its pace afterwards passes."""
    assert set(drive(pace, 0.0, 20)) == {NOW}
    assert [pace.command(MOVE, 20, 11.0 + read / 1000) for read in range(3)] == [WAITED] * 3
    assert drive(pace, 11.05, 20) == [WAITED] * 2 + [NOW] * 18


@pytest.mark.parametrize("hz", [5, 20, 100, 400])
def test_who_has_paused_drives_on_at_once(hz: float) -> None:
    """After two seconds without a command only the first is held for a newer one, which comes soon."""
    pace = Pace(0, 0, 0.0)
    drive(pace, 0.0, 100, hz)
    assert drive(pace, 100 / hz + 2.0, 100, hz) == [WAITED] + [NOW] * 99


def test_each_kind_of_command_has_a_flow_of_its_own() -> None:
    """Two topics in each cycle, one of them twice: of what has waited of each nothing passes."""
    pace = Pace(0, 0, 0.0)
    for cycle in range(100):
        for kind in (MOVE, ARM, ARM):
            assert pace.command(kind, 1, cycle / 20) is NOW
    late = [pace.command(kind, 1, 35.0 + number / 5000) for number in range(300) for kind in ("once", MOVE, ARM)]
    assert set(late) == {WAITED}, "what is said now and then has waited with the others"
    assert pace.command("once", 1, 36.0) is NOW


def test_what_has_waited_may_come_in_pieces() -> None:
    """A network that comes back takes ten commands at first, then twenty, each a round trip of 100 ms later. More than
    could be said meanwhile have not waited."""
    pace = Pace(0, 0, 0.0)
    drive(pace, 0.0, 100)
    pieces = [(50.0 + 0.1 * trip, 10 << trip) for trip in range(6)]
    taken = [pace.command(MOVE, 1, begin + number / 100_000) for begin, count in pieces for number in range(count)]
    assert set(taken) == {WAITED}
    assert [pace.command(MOVE, 1, 50.6 + number / 1000) for number in range(400)][-1] is NOW


def test_of_ever_new_kinds_only_so_many_are_known() -> None:
    """What one connection may name costs a bounded amount."""
    pace = Pace(0, 0, 0.0)
    for number in range(10 * Pace.KINDS):
        pace.command(number, 1, number / 1000)
    assert len(pace._flows) == Pace.KINDS


@pytest.mark.parametrize("hz", [30, 100, 400])
def test_who_drives_on_fast_is_held_for_a_moment_only(pace: Pace, hz: float) -> None:
    """At a high rate nothing tells the last that waited from the first that did not: a second later all pass."""
    pace = Pace(0, 0, 0.0)
    drive(pace, 0.0, 20)
    assert pace.command(MOVE, 100, 5.0) is WAITED
    taken = drive(pace, 5.0 + 1 / hz, int(2 * hz), hz)
    assert taken[-1] is NOW
    assert WAITED not in taken[int(1.1 * hz) :]


def test_a_burst_of_who_does_not_drive_passes(pace: Pace) -> None:
    """A program that says a hundred things at once now and then loses none of them, nor does a slow one."""
    pace = Pace(0, 0, 0.0)
    for second in range(0, 20, 2):
        assert [pace.command(MOVE, 1, second + number / 10_000) for number in range(100)] == [NOW] * 100
    for number in range(20):
        assert pace.command(MOVE, 3, 100.0 + 2 * number) is NOW


def test_no_limit_is_none() -> None:
    """0 is no limit."""
    pace = Pace(0, 0, 0.0)
    assert pace.command(MOVE, 1_000_000, 0.0) is NOW
    assert pace.request(1_000_000, 0.0) is NOW


def answers(pace: Pace, asked: float, now: float) -> None:
    """It is asked, and answers."""
    number = pace.recency.ask(asked)
    assert number is not None
    pace.answered(number, now)


def driving(*, until: float, hz: float = 50) -> Pace:
    """Of somebody who has driven up to then, and answers at once."""
    pace = Pace(0, 0, 0.0)
    for number in range(int(until * hz) + 1):
        assert pace.command(MOVE, 1, number / hz) is NOW
        if number % 20 == 0:
            answers(pace, number / hz, number / hz)
    assert pace.drives
    return pace


@pytest.mark.parametrize("gap_s", [1.5, 60.0])
@pytest.mark.parametrize("times", [0.5, 1.0, 1.5, 2.5, 1000.0])
def test_of_who_answers_nothing_that_waited_goes_on_however_fast_it_comes(gap_s: float, times: float) -> None:
    """What was said in the gap comes at half the pace or at a thousand times that, and nothing else of it goes on; the
    answer to a question of now is behind it, and from then on everything passes."""
    pace = driving(until=4.0)
    begin = 4.0 + gap_s
    waited = [pace.command(MOVE, 1, begin + number / (50 * times)) for number in range(int(gap_s * 50))]
    came = min(len(waited), int(Pace.DOUBT_S * 50 * times))  # who answers nothing for so long is no longer believed
    assert set(waited[:came]) == {TOO_OLD}
    assert pace.in_doubt is (came == len(waited))
    end = begin + len(waited) / (50 * times)
    answers(pace, end - 0.01, end)
    assert not pace.in_doubt
    if came == len(waited):
        assert {pace.command(MOVE, 1, end + number / 50) for number in range(100)} == {NOW}


def test_an_answer_to_an_old_question_ends_no_doubt() -> None:
    """It was asked before the network stood still, or while it did."""
    pace = driving(until=4.0)
    old = pace.recency.ask(4.1)
    assert old is not None
    assert pace.command(MOVE, 1, 9.0) is TOO_OLD
    pace.answered(old, 9.0)
    assert pace.command(MOVE, 1, 9.01) is TOO_OLD
    answers(pace, 9.02, 9.05)
    assert pace.command(MOVE, 1, 9.06) is NOW


def test_of_who_answers_a_pause_costs_nothing() -> None:
    """Nothing said for ten seconds, all questions answered: what comes then is recent, also a single command."""
    pace = driving(until=4.0)
    for number in range(25):
        answers(pace, 4.1 + 0.4 * number, 4.15 + 0.4 * number)
    assert pace.command("gripper", 1, 14.0) is NOW
    assert {pace.command(MOVE, 1, 14.0 + number / 50) for number in range(100)} == {NOW}


def test_who_stops_answering_is_judged_by_its_pace_after_a_while() -> None:
    """It drives on: for some seconds nothing passes, then everything, and later pauses cost no more than of others."""
    pace = driving(until=4.0)
    taken = drive(pace, 10.0, 1000, 50)
    held = taken.index(NOW)
    assert set(taken[:held]) == {TOO_OLD}
    assert abs(held / 50 - Pace.DOUBT_S) < 0.1
    assert set(taken[held:]) == {NOW}
    assert drive(pace, 100.0, 100, 50) == [WAITED] + [NOW] * 99


def test_what_waits_longer_than_seconds_has_waited_all_the_same() -> None:
    """Of one that answers nothing: a minute's commands that come for twenty seconds, and those said meanwhile."""
    pace = Pace(0, 0, 0.0)
    drive(pace, 0.0, 100, 50)
    late = [pace.command(MOVE, 1, 62.0 + number / 200) for number in range(4400)]
    late_s = late.index(NOW) / 200
    assert abs(late_s - 60 / 3) < 0.5, "200 a second come, 50 a second are said"


def test_who_says_a_few_things_is_not_asked(pace: Pace) -> None:
    """What existing programs send in a moment brings them no message that they did not get before."""
    drive(pace, 0.0, 20, 50)
    assert pace.drives
    assert not pace.drives_on
    drive(pace, 0.4, 1, 50)
    assert pace.drives_on


def test_no_more_questions_are_open_than_an_agent_may_leave_unanswered() -> None:
    """What it does not take does not pile up."""
    pace = driving(until=1.0)
    assert [pace.recency.ask(2.0 + n) is None for n in range(10)].count(False) == Recency.OPEN
