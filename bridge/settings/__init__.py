"""A whole settings file: one section for each of our programs, beside what the library needs (`macs_zenoh.config`).

It is TOML with up to six sections and a list of rules, one struct each::

    [mesh]                                   # MeshSettings: every program on the mesh
    connect = ["tcp/192.168.1.10:7447"]

    [gateway]                                # GatewaySettings: `macs gateway`
    port = 7000

    [robot]                                  # RobotSettings: `macs agent`
    id = 7

    [[rmw_zenoh.robots]]                     # RmwZenohSettings: `macs rmw-zenoh`, robots without anything installed
    id = 8

    [awareness]                              # AwarenessSettings: `macs awareness`
    name = "drone0"

    [operator]                               # OperatorSettings: `macs ls`, `macs stop`, `macs doctor`
    id = 5

    [record]                                 # RecordSettings: `macs record`
    on = ["stop", "deadman"]

    [[traffic]]                              # TrafficRule: every program that sends
    match = "macs/from/ros/*/nd__camera$*"
    max_hz = 10

It is read once, in ``main``, and passed down. A section has a module of its own here and not in its program's package,
because a file is read, and a command line is built, without ROS and without Zenoh. Pure, except `load`.
"""

from __future__ import annotations

import os
from typing import Any

import msgspec

from macs_zenoh.config import MeshSettings, TrafficRule
from macs_zenoh.sections import read, read_text, toml

from .awareness import AwarenessSettings
from .gateway import GatewaySettings
from .operator import OperatorSettings
from .record import RecordSettings
from .rmw_zenoh import RmwZenohRobot, RmwZenohSettings
from .robot import ROBOT_HIDES, WHO_STOPPED, RobotSettings, TopicRule

__all__ = [
    "ROBOT_HIDES",
    "WHO_STOPPED",
    "AwarenessSettings",
    "GatewaySettings",
    "OperatorSettings",
    "RecordSettings",
    "RmwZenohRobot",
    "RmwZenohSettings",
    "RobotSettings",
    "Settings",
    "TopicRule",
    "load",
    "parse",
]


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole settings file."""

    mesh: MeshSettings = MeshSettings()
    gateway: GatewaySettings = GatewaySettings()
    robot: RobotSettings = RobotSettings()
    rmw_zenoh: RmwZenohSettings = RmwZenohSettings()
    awareness: AwarenessSettings = AwarenessSettings()
    operator: OperatorSettings = OperatorSettings()
    record: RecordSettings = RecordSettings()
    traffic: list[TrafficRule] = []


def load(*paths: str | os.PathLike[str]) -> Settings:
    """Read settings files (TOML); of several, a later one wins, setting by setting.

    Raises `ConfigError`: one cannot be read, is not TOML, has an unknown name or a value out of range.
    """
    document: dict[str, Any] = {}
    settings = Settings()
    for path in paths:
        source = str(path)
        for name, section in toml(read_text(path), source).items():
            before = document.get(name)
            if isinstance(before, dict) and isinstance(section, dict):
                section = {**before, **section}
            document[name] = section
        settings = read(document, Settings, source)
    return settings


def parse(text: str, source: str = "settings") -> Settings:
    """Turn the text of a settings file into settings; ``source`` names it in errors."""
    return read(toml(text, source), Settings, source)
