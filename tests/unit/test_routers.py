"""Links between routers: how long each takes, by what it takes to both its ends."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.directory import published
from macs_zenoh.protocol.limits import ROUTER_BYTES
from macs_zenoh.protocol.routers import KEPT, Router, RouterLink, RouterSession, Trips, between, router_of


def test_the_least_of_the_last_few_trips_counts() -> None:
    """An old one is forgotten, so a link that has become slow is told as slow."""
    trips = Trips()
    assert trips.of("a") is None
    for took_s in (0.001, *[0.03] * (KEPT - 1)):
        trips.note("a", took_s)
    assert trips.of("a") == 0.001
    trips.note("a", 0.04)
    assert trips.of("a") == 0.03
    trips.keep(["b"])
    assert trips.of("a") is None


def test_a_link_takes_what_is_longer_to_its_far_end() -> None:
    """Three in a row and a fourth beside the third; what nobody can tell is left out."""
    trips = Trips()
    for zid, took_s in {"a": 0.001, "b": 0.021, "c": 0.026, "d": 0.020}.items():
        trips.note(zid, took_s)
    linked = {"a": ["b"], "b": ["a", "c", "d"], "c": ["b", "d"], "d": ["b", "c"]}
    found = between(linked, ["a"], trips)
    assert found["a", "b"] == found["b", "a"] == pytest.approx(0.02)
    assert found["c", "b"] == pytest.approx(0.005)
    assert ("b", "d") not in found  # what would be below zero
    assert ("c", "d") not in found
    assert between(linked, ["a"], Trips()) == {}
    assert between({"a": ["x"]}, ["a"], trips) == {}


def test_a_router_tells_who_is_behind_it() -> None:
    """Routers are links, others are sessions, as they are known in keys."""
    router = Router("aa", "v1.10.2-x", sessions=[RouterSession("bb", "router"), RouterSession("cc", "client")])
    assert (router.linked, router.behind) == (["bb"], {published("cc")})


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"\xff",
        b"[]",
        b"{}",
        b'{"zid":1}',
        b'{"zid":"\xff"}',
        b'{"zid":"a","sessions":[{"peer":[]}]}',
        b'{"zid":"a","x":%s}' % (b"[" * 100_000),
        b'{"zid":"a","x":"%s"}' % (b"x" * ROUTER_BYTES),
    ],
    ids=lambda answer: answer[:30].decode(errors="replace"),
)
def test_who_answers_as_a_router_is_read_as_one_or_not_at_all(answer: bytes) -> None:
    """Whoever reaches a router without rules can answer where routers tell of themselves."""
    assert router_of(answer) is None


def test_a_router_is_read_as_it_tells() -> None:
    """Fields that are not known are left out."""
    told = b'{"zid":"aa","version":"v1","sessions":[{"peer":"bb","whatami":"router","shm":false,"weight":null,'
    told += b'"links":[{"src":"tcp/1","dst":"tcp/2"}]}],"locators":["tcp/3"],"plugins":{}}'
    session = RouterSession("bb", "router", False, [RouterLink("tcp/2")])
    assert router_of(told) == Router("aa", "v1", ["tcp/3"], [session])
    assert session.address == "tcp/2"
    older = router_of(b'{"zid":"aa","sessions":[{"peer":"bb","links":["tcp/1:2",{}]},{"peer":"cc"}]}')
    assert older is not None
    assert [each.address for each in older.sessions] == ["tcp/1:2", ""]
