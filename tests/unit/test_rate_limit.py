"""What a TCP agent sends to robots has a limit, and of what waited in its connection only the newest counts."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.rate_limit import FLOODED, NOW, WAITED, Pace, Passing


@pytest.fixture
def pace() -> Pace:
    return Pace(100, 10, 0.0)


def drive(pace: Pace, begin: float, count: int, hz: float = 20) -> list[Passing]:
    return [pace.command(1, begin + number / hz) for number in range(count)]


def test_commands_and_requests_have_limits_of_their_own(pace: Pace) -> None:
    """A second's worth of each passes at once; using up one leaves the other; stops have none."""
    assert [pace.request(1, 0.0) for _ in range(12)] == [NOW] * 10 + [FLOODED] * 2
    assert [pace.command(50, 0.0) for _ in range(3)] == [NOW] * 2 + [FLOODED]
    assert pace.command(1000, 0.0, may_stop=True) is NOW
    assert pace.request(5, 0.5) is NOW


def test_after_a_gap_in_a_flow_what_comes_together_has_waited(pace: Pace) -> None:
    """Ten seconds of nothing, then what was said meanwhile; what comes at its pace afterwards passes."""
    assert set(drive(pace, 0.0, 20)) == {NOW}
    assert [pace.command(20, 11.0 + read / 1000) for read in range(3)] == [WAITED] * 3
    assert pace.command(1, 11.1) is NOW
    assert set(drive(pace, 11.2, 20)) == {NOW}


@pytest.mark.parametrize("hz", [30, 100, 400])
def test_who_drives_on_fast_is_held_for_a_moment_only(pace: Pace, hz: float) -> None:
    """At a high rate nothing tells the last that waited from the first that did not: a second later all pass."""
    pace = Pace(0, 0, 0.0)
    drive(pace, 0.0, 20)
    assert pace.command(100, 5.0) is WAITED
    taken = drive(pace, 5.0 + 1 / hz, int(2 * hz), hz)
    assert taken[-1] is NOW
    assert WAITED not in taken[int(1.1 * hz) :]


def test_a_burst_of_who_does_not_drive_passes(pace: Pace) -> None:
    """A program that says a hundred things at once now and then loses none of them, nor does a slow one."""
    pace = Pace(0, 0, 0.0)
    for second in range(0, 20, 2):
        assert [pace.command(1, second + number / 10_000) for number in range(100)] == [NOW] * 100
    for number in range(20):
        assert pace.command(3, 100.0 + 2 * number) is NOW


def test_no_limit_is_none() -> None:
    """0 is no limit."""
    pace = Pace(0, 0, 0.0)
    assert pace.command(1_000_000, 0.0) is NOW
    assert pace.request(1_000_000, 0.0) is NOW
