"""Zenoh's own configuration: made of our settings."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import zenoh

from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol import endpoints
from macs_zenoh.protocol.keyexpr import BROADCAST, GROUP, UNICAST
from macs_zenoh.protocol.messages import ROS

log = logging.getLogger("macs.mesh")

COMMANDS = "real_time"
"""The priority of commands, unless a rule says otherwise."""


def configuration(settings: MeshSettings) -> dict[str, Any]:
    """Zenoh's whole configuration as a program with these settings uses it. It may hold passwords and keys.

    Raises ConfigError.
    """
    whole: dict[str, Any] = msgspec.json.decode(str(zenoh_config(settings)))
    return whole


def warn_of_lowered(rules: Iterable[TrafficRule]) -> None:
    """Log those that give commands to robots another priority than the first: whoever waits for room at that one holds
    them up, which routers prevent at the first alone."""
    for rule in _lowered(rules):
        text = "traffic rule %s gives commands the priority %s: who waits for room at that one holds them up"
        log.warning(text, rule.match, rule.priority)


def _lowered(rules: Iterable[TrafficRule]) -> list[TrafficRule]:
    found: list[TrafficRule] = []
    for space in (UNICAST.every(type=ROS), GROUP.every(type=ROS), BROADCAST.every()):
        keys = zenoh.KeyExpr(space)
        for rule in rules:
            match = zenoh.KeyExpr(rule.match)
            if rule.priority is None or not match.intersects(keys):
                continue
            if rule.priority != COMMANDS:
                found.append(rule)
            elif match.includes(keys):
                break
    return list({id(rule): rule for rule in found}.values())


def zenoh_config(settings: MeshSettings) -> zenoh.Config:
    """Zenoh's configuration: its file if any, our defaults where the file is silent, our fields, the overrides.

    Raises ConfigError.
    """
    source = settings.config_file
    try:
        config: zenoh.Config = zenoh.Config.from_file(source) if source else zenoh.Config()
    except zenoh.ZError as error:
        raise ConfigError(str(source), first_line(error)) from error
    silent = zenoh.Config()
    for path, value, chosen in settings.zenoh():
        if chosen or not source or config.get_json(path) == silent.get_json(path):
            insert(config, path, value)
    if settings.mode == "client":
        # a client tries each router once and then we try again: with a time Zenoh would spend all of it on the first
        # router, also where the second is up, and waiting inside Zenoh cannot be interrupted
        insert(config, "connect/timeout_ms", "0")
        insert(config, "connect/exit_on_failure", "true")
    for path, value in _split(settings.overrides):
        insert(config, path, value)
    return config


def id_is_chosen(settings: MeshSettings) -> bool:
    """Whether the settings, or the file that they name, say which Zenoh id the session has. Otherwise Zenoh makes one
    up for each session.

    Raises ConfigError.
    """
    return zenoh_config(settings).get_json("id") not in ("null", zenoh.Config().get_json("id"))


_CERTIFICATE, _KEY = b"CERTIFICATE-----", b"PRIVATE KEY-----"
TLS_FILES = {
    "root_ca_certificate": _CERTIFICATE,
    "connect_certificate": _CERTIFICATE,
    "connect_private_key": _KEY,
    "listen_certificate": _CERTIFICATE,
    "listen_private_key": _KEY,
}
"""The settings that name PEM files, below ``transport/link/tls`` or after an endpoint's #, and what is inside."""


def check_files(config: zenoh.Config) -> None:
    """Try the files that TLS will read: of a missing one Zenoh only says, again and again, that it cannot connect.
    Whether key and certificate belong together is not looked at; ``macs doctor`` does.

    Raises ConfigError.
    """
    whole = msgspec.json.decode(str(config))
    common = endpoints.value_at(whole, "transport/link/tls") or {}
    for role in ("connect", "listen"):
        for endpoint in endpoints.configured(whole, role):
            if endpoints.protocol_of(endpoint) not in endpoints.TLS_PROTOCOLS:
                continue
            own, used = endpoints.own_settings(endpoint), endpoints.tls_settings(endpoint, common)
            mutual = used.get("enable_mtls") in (True, "true")
            for name, begins in TLS_FILES.items():
                needed = name.startswith(role) and (mutual or role == "listen")
                if (needed or name == "root_ca_certificate") and used.get(name):
                    where = endpoint if name in own else f"transport/link/tls/{name}"
                    _check_pem(f"zenoh configuration {where}", str(used[name]), begins)


def _check_pem(setting: str, path: str, begins: bytes) -> None:
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise ConfigError(setting, f"{path}: {error.strerror or error}") from error
    if not re.search(rb"-----BEGIN [A-Z0-9 ]*" + begins, content):
        what = "certificate" if begins == _CERTIFICATE else "private key"
        raise ConfigError(setting, f"{path}: there is no {what} in this file")


def _split(overrides: Iterable[str]) -> Iterable[tuple[str, str]]:
    for override in overrides:
        path, _, value = override.partition(":")
        yield path, value


def insert(config: zenoh.Config, path: str, value: str) -> None:
    try:
        config.insert_json5(path, value)
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh configuration {path}", f"{value} is not accepted: {first_line(error)}") from error


def first_line(error: Exception) -> str:
    return str(error).split(" at /")[0].strip().splitlines()[0]
