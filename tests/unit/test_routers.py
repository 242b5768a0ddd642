"""Links between routers: how long each takes, by what it takes to both its ends."""

from __future__ import annotations

import pytest

from macs_zenoh.protocol.directory import published
from macs_zenoh.protocol.routers import KEPT, Router, RouterSession, Trips, between


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
