"""A ROS interface package as a folder: ``package.xml`` and definitions in ``msg/``, ``srv/`` and ``action/``."""

from __future__ import annotations

import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from macs_zenoh.errors import ConfigError

KINDS = ("msg", "srv", "action")

# What ROS's generators put into every service and action.
_IMPLIED = {
    "srv": ("service_msgs", "builtin_interfaces"),
    "action": ("action_msgs", "unique_identifier_msgs", "service_msgs", "builtin_interfaces"),
}
_DEPENDS = ("depend", "build_depend", "build_export_depend", "exec_depend")
_INDEX = Path("share", "ament_index", "resource_index", "rosidl_interfaces")


@dataclass(frozen=True)
class Package:
    """What is built. ``definitions`` are relative to ``folder``, as ``msg/Pose.msg``."""

    folder: Path
    name: str
    version: str
    description: str
    depends: tuple[str, ...]
    """Names in package.xml, interface packages or not."""
    definitions: tuple[Path, ...]

    @classmethod
    def read(cls, folder: Path) -> Package:
        """Read a package's folder. Raises ConfigError: no package.xml, no definitions, a name ROS does not allow."""
        manifest = folder / "package.xml"
        try:
            root = ElementTree.parse(manifest).getroot()  # noqa: S314 - the user's own file
        except OSError as error:
            raise ConfigError(str(manifest), f"{error.strerror}; an interface package has one") from error
        except ElementTree.ParseError as error:
            raise ConfigError(str(manifest), f"not XML: {error}") from error
        name = (root.findtext("name") or "").strip()
        if not re.fullmatch(r"(?!\w*__)[a-z][a-z0-9_]*(?<!_)", name):
            raise ConfigError(str(manifest), f"<name> is {name!r}, not the name of a ROS package")
        depends = dict.fromkeys((e.text or "").strip() for tag in _DEPENDS for e in root.iter(tag))
        definitions = _definitions(folder)
        if not definitions:
            raise ConfigError(str(folder), "there is no msg/*.msg, srv/*.srv or action/*.action in it")
        return cls(
            folder=folder.resolve(),
            name=name,
            version=(root.findtext("version") or "0.0.0").strip(),
            description=" ".join((root.findtext("description") or "").split()),
            depends=tuple(depends),
            definitions=definitions,
        )

    @property
    def kinds(self) -> set[str]:
        """Which of msg, srv and action it has."""
        return {path.suffix[1:] for path in self.definitions}

    def interface_packages(self, prefixes: list[Path]) -> dict[str, Path]:
        """Every interface package needed, however indirectly, with the prefix it is installed in.

        Raises ConfigError when one that a service or an action needs is not installed. Other names in package.xml
        that are no installed interface packages (build tools) are left out.
        """
        implied = [name for kind in sorted(self.kinds) for name in _IMPLIED.get(kind, ())]
        found: dict[str, Path] = {}
        waiting = [*implied, *self.depends]
        while waiting:
            name = waiting.pop()
            prefix = next((p for p in prefixes if (p / _INDEX / name).is_file()), None)
            if prefix is None:
                if name in implied:
                    raise ConfigError(str(self.folder), f"the ROS package {name} is needed and not installed")
                continue
            if name not in found and name != self.name:
                found[name] = prefix
                waiting += _depends_of(prefix / "share" / name / "package.xml")
        return found


def prefixes() -> list[Path]:
    """Where ROS packages are installed: what was sourced, then this Python's own prefix (ROS from PyPI)."""
    sourced = [Path(entry) for entry in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if entry]
    return [*sourced, *([Path(sys.prefix)] if Path(sys.prefix) not in sourced else [])]


def _definitions(folder: Path) -> tuple[Path, ...]:
    return tuple(path.relative_to(folder) for kind in KINDS for path in sorted((folder / kind).glob(f"*.{kind}")))


def _depends_of(manifest: Path) -> list[str]:
    try:
        root = ElementTree.parse(manifest).getroot()  # noqa: S314 - installed with the package
    except (OSError, ElementTree.ParseError):
        return []
    return [(element.text or "").strip() for tag in _DEPENDS for element in root.iter(tag)]
