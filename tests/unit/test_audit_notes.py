"""How many lines of a record each may have."""

from __future__ import annotations

from bridge.audit import who
from bridge.audit.notes import FEW, Shares


def test_who_has_had_his_lines_gets_some_with_time() -> None:
    """It is told how many were left out before the first that he gets; others have theirs."""
    shares, by = Shares(), who("unity/1", "10.0.0.9:1")
    taken = [shares.take("register", by, "done", 0.0) for _ in range(Shares.AT_ONCE + 7)]
    assert taken == [0] * Shares.AT_ONCE + [None] * 7
    assert shares.take("register", who("unity/2", "10.0.0.8:1"), "done", 0.0) == 0
    assert shares.take("left", by, "done", 1.5 / Shares.PER_S) == 7
    assert shares.take("left", by, "done", 1.5 / Shares.PER_S) is None


def test_a_stop_is_noted_whoever_presses_it() -> None:
    """And what is done with tokens and recordings; but not that somebody may not, each time that he tries."""
    shares, by = Shares(), who("unity/1")
    while shares.take("deregister", by, "done", 0.0) is not None:
        pass
    for event in FEW:
        assert shares.take(event, by, "done", 0.0) == 0
    assert shares.take("release", by, "it is not allowed to", 0.0) is None


def test_an_address_is_one_whatever_its_ports_and_agents_are() -> None:
    """A new connection has no new share; where no address is known, the agent is who it is."""
    for first, second in (
        (who("unity/1", "10.0.0.9:1"), who("unity/2", "10.0.0.9:2")),
        (who(address="[fe80::1]:1"), who(address="[fe80::1]:2")),
        (who(address="10.0.0.9:1"), who(address="10.0.0.9")),
        (who("unity/1"), who("unity/1", token="anna")),
    ):
        shares = Shares()
        while shares.take("joined", first, "done", 0.0) is not None:
            pass
        assert shares.take("joined", second, "done", 0.0) is None
        assert shares.take("joined", who("unity/3"), "done", 0.0) == 0


def test_names_that_somebody_makes_up_give_no_more() -> None:
    """Once as many are known as are kept, the next one begins with what another has left."""
    shares = Shares()
    for number in range(Shares.KNOWN):
        shares._of[str(number)] = float(Shares.AT_ONCE), 0.0, 0
    assert shares.take("register", who("unity/1"), "done", 0.0) is None
    assert len(shares._of) == Shares.KNOWN
