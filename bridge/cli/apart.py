"""Where a demo is alone: a ROS domain that nobody on this machine is in, a namespace on the mesh, ports of its own.

A demo drives what it finds, and what it finds must not be somebody's robot. A robot agent of this machine may wait for
the very router that the demo starts, with the demo robot's id: hence a namespace also where the router is our own.

DDS derives its ports from the domain (RTPS 2.2, 9.6.1.1): each participant holds one of the even ports from 10 up, and
all share the first one where discovery goes by multicast. A domain is free when none of them is taken.
"""

from __future__ import annotations

import os
import random
import secrets
import socket
from collections.abc import Mapping

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Unreachable, UsageError

DOMAINS = range(1, 102)
"""Without 0, the domain of whoever has chosen none; up to 101 their ports are below Linux' ephemeral ones."""
FIRST_PORT, PORTS_EACH = 7400, 250
PARTICIPANTS = (0, *range(10, PORTS_EACH, 2))
"""Ports that somebody in the domain holds, after its first."""
RESERVATION = PORTS_EACH - 1
"""The last port is nobody's before there are 120 participants: who holds it has chosen the domain."""

LEAD_ELSEWHERE = (
    "ROS_LOCALHOST_ONLY",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "ROS_SUPER_CLIENT",
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "CYCLONEDDS_URI",
    "ZENOH_SESSION_CONFIG_URI",
    "ZENOH_CONFIG_OVERRIDE",
    "ZENOH_CONFIG",
)
"""Variables that can lead a ROS node, or a Zenoh session, out of this machine whatever its domain is."""


class Apart:
    """The demo's own place, from `of` to `close`. Whoever else asks here gets another one."""

    def __init__(self, domain: int, namespace: str, reservation: socket.socket) -> None:
        self.domain = domain
        self.namespace = namespace
        self._held = [reservation]

    @classmethod
    def of(cls, mesh: MeshSettings, *, own_router: bool) -> Apart:
        """Choose a place. ``mesh``: the settings of whoever wants a demo. Raises Unreachable, UsageError."""
        if any(override.startswith("namespace") for override in mesh.overrides):
            raise UsageError("a demo has a namespace of its own, which [mesh] overrides in the settings would replace")
        domain, reservation = free_domain(without=os.environ.get("ROS_DOMAIN_ID", ""))
        return cls(domain, "demo" if own_router else f"demo-{secrets.token_hex(3)}", reservation)

    def __str__(self) -> str:
        return f"ROS domain {self.domain}, on this machine only; mesh {self.namespace!r}"

    @property
    def shown(self) -> str:
        """What to put before a command of ROS that shall see it."""
        return f"ROS_DOMAIN_ID={self.domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"

    def environment(self, around: Mapping[str, str]) -> dict[str, str]:
        """The environment of a program in this domain and nowhere else."""
        kept = {name: value for name, value in around.items() if name not in LEAD_ELSEWHERE}
        own = {"ROS_DOMAIN_ID": str(self.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        if around.get("ROS_DISTRO") == "humble":  # it knows no range, and later ones warn of this
            own["ROS_LOCALHOST_ONLY"] = "1"
        return {**kept, **own}

    def take_port(self, port: int) -> bool:
        """Hold a TCP port against other demos until its program listens there; whether none of them has it.

        By the UDP port of that number, which nobody else wants: a TCP port that is only bound is in the way of its own
        program, or of nobody.
        """
        held = _bound("127.0.0.1", port)
        if held is not None:
            self._held.append(held)
        return held is not None

    def close(self) -> None:
        """Let others have all of it."""
        for held in self._held:
            held.close()


def free_domain(*, without: str = "") -> tuple[int, socket.socket]:
    """A domain that nobody is in, and what holds it against others who choose one so. Raises Unreachable.

    ``without``: one that is somebody's in any case, on other machines perhaps.
    """
    domains = [domain for domain in DOMAINS if str(domain) != without.strip()]
    random.shuffle(domains)
    for domain in domains:
        reservation = _bound("", first_port(domain) + RESERVATION)
        if reservation is None:
            continue
        if not inhabited(domain):
            return domain, reservation
        reservation.close()
    raise Unreachable("a ROS domain of its own", f"somebody is in each of {len(domains)}")


def first_port(domain: int) -> int:
    """Where the ports of a domain begin."""
    return FIRST_PORT + PORTS_EACH * domain


def inhabited(domain: int) -> bool:
    """Whether a participant of this machine is in a domain."""
    for offset in PARTICIPANTS:
        probe = _bound("", first_port(domain) + offset)
        if probe is None:
            return True
        probe.close()
    return False


def _bound(host: str, port: int) -> socket.socket | None:
    """A UDP port, None when it is taken. Not shared with those who share it among themselves."""
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.bind((host, port))
    except OSError:
        found.close()
        return None
    return found
