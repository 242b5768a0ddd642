"""Where a demo is alone: free domains, variables that lead elsewhere, ports that two demos want."""

from __future__ import annotations

import socket

import pytest

from bridge.cli import apart
from bridge.cli.apart import Apart
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import UsageError


@pytest.mark.parametrize("offset", [0, 10, 12, 248])
def test_a_domain_with_a_participant_is_inhabited(offset: int) -> None:
    """A port that DDS derives from a domain is taken by who is in it, by whichever participant."""
    domain, reservation = apart.free_domain()
    with reservation, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        assert not apart.inhabited(domain)
        participant.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        participant.bind(("", apart.first_port(domain) + offset))
        assert apart.inhabited(domain)


def test_two_demos_have_two_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain and a port that one demo has chosen are not chosen by another, as long as it lasts."""
    monkeypatch.setattr(apart, "DOMAINS", range(90, 92))
    first, second = (Apart.of(MeshSettings(), own_router=True) for _ in range(2))
    assert {first.domain, second.domain} == {90, 91}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    assert first.take_port(port)
    assert not second.take_port(port)
    first.close()
    assert second.take_port(port)
    second.close()


def test_the_users_domain_is_not_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Robots in the domain of the environment may be on other machines."""
    monkeypatch.setattr(apart, "DOMAINS", range(90, 92))
    monkeypatch.setenv("ROS_DOMAIN_ID", "91")
    chosen = Apart.of(MeshSettings(), own_router=True)
    assert chosen.domain == 90
    chosen.close()


def test_nothing_in_the_environment_leads_elsewhere() -> None:
    """The demo's programs keep what else is set, and lose what would connect them with others."""
    place = Apart.of(MeshSettings(), own_router=False)
    around = dict.fromkeys(apart.LEAD_ELSEWHERE, "elsewhere") | {"ROS_DOMAIN_ID": "0", "HOME": "/home/anna"}
    around["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"
    assert place.environment(around) == {
        "ROS_DOMAIN_ID": str(place.domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "HOME": "/home/anna",
    }
    place.close()


def test_a_router_of_others_gets_a_namespace_that_nobody_has() -> None:
    """Two demos on one router do not meet."""
    places = [Apart.of(MeshSettings(), own_router=False) for _ in range(2)]
    assert len({place.namespace for place in places}) == 2
    for place in places:
        place.close()


def test_settings_cannot_take_the_namespace_away() -> None:
    """An override of Zenoh's configuration would win over it."""
    with pytest.raises(UsageError, match="namespace"):
        Apart.of(MeshSettings(overrides=['namespace:"site1"']), own_router=True)
