"""Who may connect, and who waits."""

from __future__ import annotations

from bridge.gateway.admission import Churn


def test_short_connections_are_paid_for_with_time() -> None:
    """Some are free, long ones always; the wait grows with what is more and ends by itself, for each address."""
    churn = Churn()
    for number in range(Churn.FREE):
        churn.ended("a", 0.1, number / 1e6)
    assert churn.wait_s("a", 0.001) == 0
    churn.ended("a", Churn.SOON_S, 0.001)
    assert churn.wait_s("a", 0.001) == 0
    for _ in range(100):
        churn.ended("a", 0.1, 0.001)
    assert 1.5 < churn.wait_s("a", 0.001) <= 100 / Churn.PER_S
    for _ in range(10_000):
        churn.ended("a", 0.1, 0.001)
    assert churn.wait_s("a", 0.001) == Churn.MOST_S
    assert churn.wait_s("b", 0.001) == 0
    assert churn.wait_s("a", 0.001 + 10_700 / Churn.PER_S) == 0


def test_addresses_that_are_remembered_are_bounded() -> None:
    """The one that made short connections longest ago is forgotten first."""
    churn = Churn()
    for number in range(2 * Churn.ADDRESSES):
        churn.ended(str(number), 0.0, 0.0)
    assert len(churn._owed) == Churn.ADDRESSES
