"""Zenoh's endpoints: what is in them, what can be wrong with them, and where a configuration has them."""

from __future__ import annotations

from typing import Any

import pytest

from macs_zenoh.protocol import endpoints


@pytest.mark.parametrize(
    ("endpoint", "where"),
    [
        ("tcp/127.0.0.1:7447", ("127.0.0.1", 7447)),
        ("tls/[::1]:7447#iface=lo", ("::1", 7447)),
        ("tcp/router.site:7447?prio=6-7", ("router.site", 7447)),
        ("unixsock-stream//run/zenoh.sock", None),
        ("tcp/host", None),
    ],
)
def test_an_endpoint_says_where_it_is(endpoint: str, where: tuple[str, int] | None) -> None:
    """Host and port come out of endpoints that have them."""
    assert endpoints.address_of(endpoint) == where


@pytest.mark.parametrize("host", ["10.0.0.1", "::1", "router.site", "fe80::1%eth0"])
def test_what_is_written_is_read(host: str) -> None:
    """Protocol, host and port come out of an endpoint as they were put in."""
    endpoint = endpoints.written("tls", host, 7447)
    assert endpoints.protocol_of(endpoint) == "tls"
    assert endpoints.address_of(endpoint) == (host, 7447)
    assert endpoints.problem(endpoint) == ""
    assert endpoints.by_protocol("tcp", endpoint) == endpoints.written("tcp", host, 7447)


@pytest.mark.parametrize(
    ("endpoint", "problem"),
    [
        ("10.0.0.1:7447", "is not a Zenoh endpoint, write tcp/10.0.0.1:7447"),
        ("router", "is not a Zenoh endpoint, as in tcp/10.0.0.1:7447"),
        ("tcp/a b:1", "is not a Zenoh endpoint"),
        ("http/a:1", "begins with 'http'"),
        ("tcp/10.0.0.1", "needs a host and a port"),
        ("tcp/::1:7447", "needs brackets around its address: tcp/[::1]:7447"),
        ("tcp/a:0", "has the port 0, allowed is 1..65535"),
        ("tcp/a:65536", "has the port 65536"),
        ("unixpipe/some", ""),
        ("quic/a:1?prio=6-7#x=1", ""),
    ],
)
def test_what_can_never_work_is_told(endpoint: str, problem: str) -> None:
    """In words that stand behind the endpoint; nothing is said of one that might work."""
    assert endpoints.problem(endpoint).startswith(problem)
    assert bool(endpoints.problem(endpoint)) is bool(problem)


@pytest.mark.parametrize(
    ("wanted", "found"),
    [
        ({"endpoints": ["tcp/a:1", ["tcp/b:2", "tcp/c:3"]]}, ["tcp/a:1", "tcp/b:2", "tcp/c:3"]),
        ({"endpoints": {"client": ["tcp/a:1"], "router": ["tcp/b:2"]}}, ["tcp/a:1"]),
        ({"endpoints": {"router": ["tcp/b:2"]}}, []),
        ({"endpoints": None}, []),
        ({}, []),
        (None, []),
    ],
)
def test_a_configuration_has_them_in_several_forms(wanted: dict[str, Any] | None, found: list[str]) -> None:
    """One list, one per mode, or a list in a list; or none."""
    assert list(endpoints.configured({"connect": wanted, "mode": None})) == found
    assert list(endpoints.configured({"listen": wanted}, "listen")) == found
