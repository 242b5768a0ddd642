"""Zenoh's own configuration: made of our settings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec
import zenoh

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError


def configuration(settings: MeshSettings) -> dict[str, Any]:
    """Zenoh's whole configuration as a program with these settings uses it. It may hold passwords and keys.

    Raises ConfigError.
    """
    whole: dict[str, Any] = msgspec.json.decode(str(zenoh_config(settings)))
    return whole


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
