"""One notation for hosts and ports: what is printed can be read, and what is wrong is told."""

from __future__ import annotations

import pytest

from bridge.settings import GatewaySettings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol import addresses
from macs_zenoh.protocol.addresses import Address


@pytest.mark.parametrize(
    ("text", "address", "printed"),
    [
        ("10.0.0.1:7001", Address("10.0.0.1", 7001), "10.0.0.1:7001"),
        ("10.0.0.1", Address("10.0.0.1", 7000), "10.0.0.1:7000"),
        ("gateway.local:7001", Address("gateway.local", 7001), "gateway.local:7001"),
        ("localhost", Address("localhost", 7000), "localhost:7000"),
        ("::1", Address("::1", 7000), "[::1]:7000"),
        ("[::1]", Address("::1", 7000), "[::1]:7000"),
        ("[::1]:7001", Address("::1", 7001), "[::1]:7001"),
        ("[fe80::1%eth0]:7001", Address("fe80::1%eth0", 7001), "[fe80::1%eth0]:7001"),
        ("::", Address("::", 7000), "[::]:7000"),
        ("::ffff:10.0.0.1", Address("::ffff:10.0.0.1", 7000), "[::ffff:10.0.0.1]:7000"),
    ],
)
def test_what_is_read_is_printed_so_that_it_can_be_read(text: str, address: Address, printed: str) -> None:
    """Host and port, either family, with and without a port; printing and reading again changes nothing."""
    assert addresses.parse(text, 7000) == address
    assert str(address) == printed
    assert addresses.parse(printed, 1) == address


@pytest.mark.parametrize(
    "text",
    [
        *("", ":7000", "host:", "host:port", "host:0", "host:65536", "host:7000:1", "[::1", "[::1]7000"),
        *("[host]:7000", "::1:70000:", "a b:7000", "host:\u0667", "tcp/10.0.0.1:7447", "[]:7000", "-x:1"),
    ],
)
def test_what_is_no_address_is_refused(text: str) -> None:
    """One sentence that names it."""
    with pytest.raises(ValueError, match=r"is no|is an endpoint"):
        addresses.parse(text, 7000)


@pytest.mark.parametrize(
    ("host", "inside"), [("::", "::"), ("[::]", "::"), ("[::1]", "::1"), ("a.b", "a.b"), ("", "")]
)
def test_a_host_may_have_brackets(host: str, inside: str) -> None:
    """As an option, and in a settings file."""
    assert addresses.bare(host) == inside
    assert GatewaySettings(host=host).host == inside


@pytest.mark.parametrize("host", ["0.0.0.0:7000", "[::]:7000", "tcp/0.0.0.0", "a b", "[a]", "::1::", "-"])
def test_what_is_no_host_is_wrong_configuration(host: str) -> None:
    """A host with a port, an endpoint, or nonsense ends a program at once."""
    with pytest.raises(ConfigError, match=r"gateway\.host"):
        GatewaySettings(host=host)


def test_an_endpoint_with_ipv6_needs_brackets() -> None:
    """Without them nobody knows where the address ends; how it is written is told."""
    with pytest.raises(ConfigError, match=r"tcp/\[::1\]:7447"):
        MeshSettings(connect=["tcp/::1:7447"])
    assert MeshSettings(connect=["tcp/[::1]:7447"], listen=["tcp/[::]:0", "udp/0.0.0.0:7447"])


@pytest.mark.parametrize(
    ("seen", "host"),
    [
        ("::ffff:10.0.0.7", "10.0.0.7"),
        ("::FFFF:10.0.0.7", "10.0.0.7"),
        ("10.0.0.7", "10.0.0.7"),
        ("::1", "::1"),
        ("::ffff:a00:7", "::ffff:a00:7"),
    ],
)
def test_a_peer_of_ipv4_is_one(seen: str, host: str) -> None:
    """Limits and logs count an address once, whichever socket took its connection."""
    assert addresses.of_peer(seen) == host
