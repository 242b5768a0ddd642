"""Files that come with the package: settings and units to start from (config/), ROS interface packages (interfaces/).

In a checkout ``bridge/data`` links to those folders; a wheel holds copies.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

DATA = files("bridge").joinpath("data")


def text(*parts: str) -> str:
    """A file of config/, as ``text("one-host", "robot.toml")``."""
    return DATA.joinpath("/".join(("config", *parts))).read_text(encoding="utf-8")


def interface_packages() -> list[str]:
    """Names of the ROS interface packages that are shipped."""
    return sorted(folder.name for folder in DATA.joinpath("interfaces").iterdir() if folder.is_dir())


def interface_package(name: str) -> Path:
    """The folder of a shipped ROS interface package."""
    with as_file(
        DATA.joinpath("interfaces").joinpath(name)
    ) as folder:  # a package is never imported out of a zip file here
        return folder
