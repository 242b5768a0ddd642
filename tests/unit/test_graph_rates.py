"""Rates, sizes and ages of messages, over the last so many."""

from __future__ import annotations

import math

import pytest

from bridge.graph.rates import Ages, Arrivals, Sizes, bytes_of


def test_the_rate_is_that_of_the_window() -> None:
    """Only the last messages count; one is not enough for a rate."""
    arrivals = Arrivals(window=4)
    assert arrivals.facts() is None
    assert arrivals.lines() is None
    arrivals.came(0.0)
    assert arrivals.facts() is None
    for number in range(1, 11):
        arrivals.came(number * 1.0)
    for number in range(1, 5):
        arrivals.came(10 + number / 1000)
    rate_hz, least, greatest, deviation, window = arrivals.facts() or ()
    assert rate_hz == pytest.approx(1000)
    assert least == pytest.approx(0.001)
    assert greatest == pytest.approx(0.001)
    assert deviation == pytest.approx(0, abs=1e-9)
    assert window == 5
    assert arrivals.lines() == "average rate: 1000.000\n\tmin: 0.001s max: 0.001s std dev: 0.00000s window: 5"


def test_messages_of_one_moment_have_no_finite_rate() -> None:
    """Nothing is divided by zero."""
    arrivals = Arrivals()
    sizes = Sizes()
    for _ in range(3):
        arrivals.came(1.0)
        sizes.came(1.0, 10)
    assert (arrivals.facts() or (0,))[0] == math.inf
    assert (sizes.facts() or (0,))[0] == math.inf


def test_bytes_per_second_count_whole_messages() -> None:
    """The first message of the window begins its time, and is not counted in it."""
    sizes = Sizes()
    for number in range(11):
        sizes.came(number / 10, 1000 + number)
    per_s, mean, least, greatest, window = sizes.facts() or ()
    assert per_s == pytest.approx(sum(range(1001, 1011)))
    assert (mean, least, greatest, window) == (1005, 1000, 1010, 11)
    shown = "10.05 KB/s from 11 messages\n\tMessage size mean: 1.00 KB min: 1.00 KB max: 1.01 KB"
    assert sizes.lines() == shown


def test_ages_may_be_negative() -> None:
    """A clock that is ahead shows as what it is."""
    ages = Ages()
    for age in (0.002, -0.001):
        ages.came(age)
    assert ages.lines() == "average delay: 0.001\n\tmin: -0.001s max: 0.002s std dev: 0.00150s window: 2"


@pytest.mark.parametrize(
    ("number", "shown"), [(0, "0 B"), (941.4, "941 B"), (12_500, "12.50 KB"), (3.4e6, "3.40 MB"), (2e9, "2.00 GB")]
)
def test_sizes_are_shown_by_thousands(number: float, shown: str) -> None:
    """As ros2cli does."""
    assert bytes_of(number) == shown
