"""From a policy to a directory: certificates, routers' configurations, clients' settings. Run again, it changes what
has to change and keeps the rest."""

from __future__ import annotations

import datetime as dt
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from bridge.security import certificates, files, headsets
from bridge.security.certificates import (
    AUTHORITY,
    CA_DIRECTORY,
    CERTIFICATE,
    KEY,
    PRIVATE_DIRECTORY,
    PRIVATE_FILE,
    Issued,
)
from bridge.security.policy import ALL, Policy, Router
from macs_zenoh.errors import UsageError

ROUTER_FILE, SETTINGS_FILE = "router.json5", "macs.toml"
FILES = (ROUTER_FILE, SETTINGS_FILE, CERTIFICATE, KEY, AUTHORITY)
"""Of a node's directory."""


@dataclass(frozen=True)
class Report:
    """What `generate` did."""

    into: Path
    authority: Issued
    issued: list[Issued]
    written: list[Path] = field(default_factory=list)
    """Configurations and settings that are new or have changed."""
    orphaned: list[tuple[str, dt.datetime]] = field(default_factory=list)
    """Names that are in no policy any more, and when their certificates end."""

    @property
    def routers_changed(self) -> list[str]:
        """Routers that have to be started again: their rules or their certificate are new."""
        names = {path.parent.name for path in self.written if path.name == ROUTER_FILE}
        names |= {one.name for one in self.issued if one.why and (self.into / one.name / ROUTER_FILE).exists()}
        return sorted(names)


def generate(
    policy: Policy,
    into: Path,
    now: dt.datetime,
    *,
    at: str | None = None,
    renew: Collection[str] = (),
    new_authority: bool = False,
) -> Report:
    """Write everything that follows from a policy.

    Args:
        into: the directory; made if it is not there. What is in it only its owner can look into.
        now: certificates are good from a day before.
        at: where a node's directory will be on its machine: ``/etc/macs`` makes ``/etc/macs/robot-7/key.pem``. None:
            where it is written.
        renew: names whose certificates are made anew in any case; ``all``.
        new_authority: everybody gets a certificate of a new authority; those of the old one are good for nothing.

    Raises ConfigError: files there cannot be used. UsageError: a name to renew is not in the policy, or a file cannot
    be written.
    """
    names = [node.name for node in policy.nodes]
    for headset in policy.headsets:
        headsets.rights_of(policy, headset)
    for name in renew:
        if name not in (*names, *(headset.name for headset in policy.headsets), ALL):
            raise UsageError(f"there is no {name!r} in the policy to renew")
    try:
        into.mkdir(mode=PRIVATE_DIRECTORY, parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{into}: {error.strerror or error}") from error
    certificates.check_own(into)
    for directory in [into / CA_DIRECTORY, *(into / name for name in names)]:
        certificates.check_own(directory, *(directory / name for name in FILES))
    authority, about_authority = certificates.authority(into, policy, now, renew=new_authority)
    report = Report(into, about_authority, [])
    for node in policy.nodes:
        directory = into / node.name
        anew = node.name in renew or ALL in renew
        router = node if isinstance(node, Router) else None
        report.issued.append(authority.issue(directory, router, policy, now, renew=anew))
        there = f"{at.rstrip('/')}/{node.name}" if at is not None else str(directory.resolve())
        if isinstance(node, Router):
            _write(directory / ROUTER_FILE, files.router_json5(policy, node, there), report)
        else:
            _write(directory / SETTINGS_FILE, files.settings_toml(policy, node, there), report)
    known = {}
    for headset in policy.headsets:
        anew = headset.name in renew or ALL in renew
        known[headset.name] = headsets.secret_of(into / headset.name, renew=anew)
    for gateway in policy.gateways if policy.headsets else ():
        content = headsets.tokens_of(policy, gateway, into, now, known=known)
        _write(into / gateway.name / headsets.TOKENS_FILE, content.decode(), report)
    report.orphaned.extend(_orphaned(into, names))
    return report


def _write(path: Path, text: str, report: Report) -> None:
    content = text.encode()
    try:
        if path.read_bytes() == content:
            return
    except OSError:
        pass
    certificates.write(path, content, PRIVATE_FILE)
    report.written.append(path)


def _orphaned(into: Path, names: Collection[str]) -> list[tuple[str, dt.datetime]]:
    found = []
    for directory in sorted(path for path in into.iterdir() if path.is_dir()):
        if directory.name not in (*names, CA_DIRECTORY):
            until = certificates.certificate_until(directory)
            if until is not None:
                found.append((directory.name, until))
    return found
