"""Credit of frames: earned with time, never by connecting again."""

from __future__ import annotations

from macs_zenoh.protocol.credit import Credit, Credits


def test_a_seconds_worth_may_come_at_once_and_the_rest_at_the_rate() -> None:
    """What is not covered is not taken, and time covers more."""
    credit = Credit(20.0, 0.0)
    assert sum(credit.take(1, 0.0) for _ in range(100)) == 20
    assert not credit.take(1, 0.04)
    assert credit.take(1, 0.1)
    assert sum(credit.take(1, 60.0) for _ in range(100)) == 20


def test_without_a_rate_everything_is_covered() -> None:
    """0 is no limit."""
    credit = Credit(0.0, 0.0)
    assert all(credit.take(1, 0.0) for _ in range(1000))


def test_who_connects_again_goes_on_with_what_was_left() -> None:
    """5 000 connections of one address within a second have two seconds' worth together; another's are not touched."""
    kept = Credits[str](20.0)
    taken = 0
    for number in range(5000):
        now = number / 5000
        credit = kept.enter("attacker", now)
        taken += sum(credit.take(1, now) for _ in range(20))
        kept.leave("attacker", credit, now)
    assert taken <= 40
    assert kept.enter("neighbour", 1.0).left(1.0) == 20.0


def test_addresses_are_forgotten_when_they_are_as_good_as_new() -> None:
    """Memory does not grow with the addresses that ever connected."""
    kept = Credits[int](20.0)
    for address in range(10_000):
        now = address / 100
        credit = kept.enter(address, now)
        credit.take(20, now)
        kept.leave(address, credit, now)
    assert len(kept._left) <= 102
    assert len(kept._left) == len(kept._ended)


def test_credit_of_parallel_connections_is_kept_apart() -> None:
    """Who comes again gets the smallest that was left."""
    kept = Credits[str](10.0)
    first, second = kept.enter("a", 0.0), kept.enter("a", 0.0)
    assert first.take(10, 0.0)
    assert second.take(2, 0.0)
    kept.leave("a", second, 0.0)
    kept.leave("a", first, 0.0)
    assert kept.enter("a", 0.0).left(0.0) == 0.0
    assert kept.enter("a", 0.0).left(0.0) == 8.0
    assert kept.enter("a", 0.0).left(0.0) == 10.0
