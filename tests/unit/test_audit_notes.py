"""How many lines of a record each may have."""

from __future__ import annotations

from bridge.audit import who
from bridge.audit.notes import BEFORE, FEW, Shares


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
    assert shares.take("stop", by, BEFORE, 0.0) == 0
    for event in ("stop", "release"):
        assert shares.take(event, by, "it is not allowed to", 0.0) is None


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
    """However many he takes, and in whatever order: all together have one share besides, and what was refused leaves
    half of it. Who displaces another tells of none that was left out of his."""

    class Small(Shares):
        AT_ONCE, ALL_AT_ONCE, KNOWN = 40, 640, 100

    few, many = [f"unity/{number}" for number in range(30)], [f"unity/{number}" for number in range(150)]
    for names in (few * Small.AT_ONCE, many * 20):
        shares = Small()
        refused = [shares.take("register", who(name), "it may not", 0.0) for name in names]
        assert refused.count(None) == len(names) - Small.ALL_AT_ONCE // 2
        done = [shares.take("joined", who(f"robot/{number}"), "done", 0.0) for number in range(Small.ALL_AT_ONCE // 2)]
        assert done == [0] * len(done)
        assert shares.take("joined", who("robot/x"), "done", 0.0) is None
        assert shares.take("stop", who("unity/1"), "done", 0.0) == 0
        assert len(shares._of) == Small.KNOWN
        later = Small.ALL_AT_ONCE / Small.ALL_PER_S
        again = [shares.take("joined", who(name), "done", later) for name in many * 20]
        assert len(again) - again.count(None) == Small.ALL_AT_ONCE


def test_a_host_has_one_share_whatever_addresses_of_ipv6_it_takes() -> None:
    """Of a network all; but those that each host of a link makes for itself are apart."""
    shares = Shares()
    taken = [
        shares.take("joined", who(address=f"[2001:db8:0:1::{number % 0xFFFF:x}]:1"), "done", 0.0)
        for number in range(2 * Shares.AT_ONCE)
    ]
    assert taken.count(None) == Shares.AT_ONCE
    assert shares.take("joined", who(address="2001:db8:0:1:ffff::1"), "done", 0.0) is None
    assert shares.take("joined", who(address="[2001:db8:0:2::1]:1"), "done", 0.0) == 0
    for _ in range(2 * Shares.AT_ONCE):
        shares.take("joined", who(address="[fe80::1%eth0]:1"), "done", 0.0)
    assert shares.take("joined", who(address="[fe80::2%eth0]:1"), "done", 0.0) == 0
