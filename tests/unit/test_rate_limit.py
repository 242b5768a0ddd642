"""What a TCP agent sends to robots has a limit, and of what waited in its connection only the newest counts."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.rate_limit import FLOODED, NOW, TOGETHER, WAITED, Pace, Passing

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


def test_many_who_send_all_that_one_may_share_what_a_few_may() -> None:
    """Twenty at their limit have no more together than four; who sends little passes whatever they do."""
    together = Credit(TOGETHER * 100, 0.0)
    crowd = [Pace(0, 100, 0.0, together) for _ in range(20)]
    modest, passed, little = Pace(0, 100, 0.0, together), 0, 0
    for number in range(10_000):
        now = number / 1000
        passed += sum(pace.request(1, now) is NOW for pace in crowd)
        if number % 100 == 0:
            little += modest.request(1, now) is NOW
    at_first = 20 * 100 * (1 - Pace.LITTLE)
    assert passed <= TOGETHER * 100 * 11 + 2 * at_first
    assert little == 100


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
