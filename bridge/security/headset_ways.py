"""How a headset's browser reaches this machine's web port, so that it gives pages WebXR: in a secure context.

A browser takes a page for secure that comes over HTTPS with a certificate that it trusts, or from ``localhost``. So
there are two ways: a cable, over which ``localhost`` of the headset is this machine (``adb reverse``), and a
certificate of an authority of one's own, which is installed on the headset once.
"""

from __future__ import annotations

import datetime as dt
import fcntl
import ipaddress
import socket
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from macs_zenoh.protocol.addresses import joined

PAGE = "/xr"
MADE_BY_PROGRAMS = ("docker", "veth", "br-", "virbr", "cni", "flannel")
"""Networks within this machine begin like this: no headset is there."""
_SIOCGIFADDR = 0x8915
MOST_DAYS = 825
"""Devices of Apple take no certificate that lasts longer."""


@dataclass(frozen=True)
class Way:
    """One way for a headset to the page. ``secure``: whether its browser gives the page WebXR there."""

    kind: str
    url: str
    secure: bool
    steps: list[str] = field(default_factory=list)


def own_addresses() -> list[str]:
    """IPv4 addresses of this machine where others reach it, without those of networks within it."""
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            if name.startswith(MADE_BY_PROGRAMS):
                continue
            try:
                asked = struct.pack("256s", name.encode()[:15])
                found.append(socket.inet_ntoa(fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, asked)[20:24]))
            except OSError:
                continue  # it has none
    return [address for address in found if not ipaddress.ip_address(address).is_loopback]


def own_names() -> list[str]:
    """What this machine is called: by itself, and where mDNS runs (Avahi, Bonjour) by others."""
    own = socket.gethostname().lower()
    return [own] if own.endswith(".local") else [f"{own}.local", own]


def certify(into: Path, hosts: Sequence[str], days: int, now: dt.datetime) -> str:
    """Have a certificate for these hosts in ``into``/page, of an authority in ``into``/ca; both are kept while they
    are good. Why it was made, empty when it was kept. Raises ConfigError, MissingExtra."""
    from bridge.security import certificates, policy

    router = policy.Router(name="page", addresses=sorted({*hosts, "localhost", "127.0.0.1"}))
    page = policy.Policy(routers=[router], namespace="page", certificates=policy.Certificates(days=days, ca_days=3650))
    certificates.private_directory(into)
    authority, _ = certificates.authority(into, page, now)
    made = authority.issue(into / "page", router, page, now, renew=False)
    # Android and visionOS know a certificate by this ending
    certificates.write(into / "ca.crt", authority.pem, certificates.PUBLIC_FILE)
    return made.why


def ways(hosts: Iterable[str], port: int, authority: Path | None) -> list[Way]:
    """All ways to the page at these hosts, the cable first. With an ``authority``, a file, the port speaks TLS."""
    scheme = "http" if authority is None else "https"
    usb = Way(
        "usb",
        f"{scheme}://localhost:{port}{PAGE}",
        True,
        [
            "turn on developer mode on the headset, connect it by a cable, and allow this computer in the headset",
            f"adb reverse tcp:{port} tcp:{port}",
            "again after each time that it was unplugged",
        ],
    )
    over_network = []
    for host in hosts:
        if authority is None:
            over_network.append(Way("http", f"{scheme}://{joined(host, port)}{PAGE}", False, [_NOT_SECURE]))
        else:
            over_network.append(Way("https", f"{scheme}://{joined(host, port)}{PAGE}", True, _install(authority)))
    return [usb, *over_network]


_NOT_SECURE = (
    "no secure context: the browser shows the flat scene and hides WebXR; use the cable, or --into DIR, which makes a"
    " certificate"
)


def _install(authority: Path) -> list[str]:
    return [
        f"copy {authority} to the headset, by cable (adb push {authority} /sdcard/Download/) or by mail",
        "Quest, Pico: search the Settings for 'CA certificate' and install it from Download",
        "Vision Pro: open it, install the profile, and trust it (General, About, Certificate Trust Settings)",
        "without it the browser warns, and is right: nobody can tell this machine from one that only says it is it",
    ]
