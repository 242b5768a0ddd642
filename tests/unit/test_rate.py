"""At most so much per second."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from macs_zenoh.protocol.rate import Rate


def test_one_at_a_time_without_bursts() -> None:
    """What passes is followed by a pause of its size, and a pause is not saved up."""
    rate = Rate(10)
    passed = []
    for tick in range(100):
        now = tick / 50
        if rate.allows(now):
            rate.take(1, now)
            passed.append(now)
    assert 19 <= len(passed) <= 20
    late = 10.0
    rate.take(1, late)
    assert not rate.allows(late + 0.09)
    assert rate.allows(late + 0.11)


def test_a_burst_passes_and_one_more() -> None:
    """So much as the burst is worth may come at once, and then one, of any size."""
    rate = Rate(100, burst_s=0.1)
    taken = 0
    while rate.allows(0.0):
        rate.take(1, 0.0)
        taken += 1
    assert taken in (11, 12)  # a sum of hundredths is not exact
    assert rate.due > 0.0


@given(st.floats(0.1, 1000), st.floats(0, 1), st.lists(st.floats(0, 0.5), max_size=50))
def test_what_is_due_is_allowed(per_s: float, burst_s: float, gaps: list[float]) -> None:
    """Whoever waits until it is due may pass then, and not a moment sooner."""
    rate, now = Rate(per_s, burst_s), 0.0
    for gap in gaps:
        now += gap
        if rate.allows(now):
            rate.take(1, now)
        else:
            assert rate.due > now
            assert rate.allows(rate.due + 1e-6)
