"""From a ``dataExchangeType`` to the class of an installed ROS interface; nothing else is ever imported.

A name from the network is looked up in the ament index, where every interface package registers what it has
(resource type ``rosidl_interfaces``). Only then is that package's ``msg``, ``srv`` or ``action`` module imported.
"""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

from bridge.ros.shapes import Array, Number, Sequence, Shape, Structure, Text
from macs_zenoh.errors import Refused

_NAME = re.compile(
    r"(?P<package>(?!\w*__)[a-z][a-z0-9_]{0,127}(?<!_))/(?:(?P<kind>msg|srv|action)/)?(?P<name>[A-Z][A-Za-z0-9]{0,127})"
)
_INDEX = Path("share", "ament_index", "resource_index", "rosidl_interfaces")


class InterfaceName(NamedTuple):
    """An interface by name: ``geometry_msgs``, ``msg``, ``Twist``."""

    package: str
    kind: str
    name: str

    def __str__(self) -> str:
        return f"{self.package}/{self.kind}/{self.name}"

    @property
    def short(self) -> str:
        """As headsets write it: ``geometry_msgs/Twist``."""
        return f"{self.package}/{self.name}"

    @classmethod
    def parse(cls, text: str, kind: str) -> InterfaceName:
        """Read ``pkg/Name`` or ``pkg/msg/Name``, where ``kind`` is expected. Raises Refused."""
        match = _NAME.fullmatch(text)
        if match is None:
            raise Refused(f"{text[:80]!r} is not the name of a ROS type, as in geometry_msgs/Twist")
        if match["kind"] not in (None, kind):
            raise Refused(f"{text} is a {match['kind']} type, a {kind} type was expected")
        return cls(match["package"], kind, match["name"])

    def check(self, name: str, types: Collection[str]) -> None:
        """Raise Refused when the robot knows something of this name, and none of its types is this one."""
        if types and str(self) not in types:
            raise Refused(f"{name} has type {' and '.join(sorted(types))} on this robot, not {self}")


def resolve(text: str, kind: str = "msg") -> type[Any]:
    """The class of an installed interface. ``kind`` is ``msg``, ``srv`` or ``action``.

    Raises Refused: no valid name, of another kind, or not installed.
    """
    name = InterfaceName.parse(text, kind)
    found = _resolved.get(name)
    if found is None:
        found = _resolved[name] = _load(name)
    return found


_resolved: dict[InterfaceName, type[Any]] = {}
"""Only types that exist get in here, so it cannot grow by what others ask for."""


def _load(name: InterfaceName) -> type[Any]:
    interfaces = _registered(name.package)
    if interfaces is None:
        raise Refused(f"type {name} is not installed on this robot: there is no ROS interface package {name.package}")
    if not {f"{name.kind}/{name.name}.{ending}" for ending in ("idl", name.kind)} & interfaces:
        raise Refused(f"type {name} is not installed on this robot: {name.package} is, but has no such type")
    try:
        found = getattr(importlib.import_module(f"{name.package}.{name.kind}"), name.name)
        if not isinstance(found, type):
            raise Refused(f"type {name} is registered on this robot, but its class is something else")
        _load_type_support(found)
    except Refused:
        raise
    except Exception as error:  # its module is somebody else's code: a field named `from` is a SyntaxError
        problem = f"{type(error).__name__}: {error}"
        raise Refused(f"type {name} is registered on this robot, but cannot be imported: {problem}") from error
    return found


def _load_type_support(found: type[Any]) -> None:
    """Load the C code of a message, or of a service's or an action's messages. Raises what it raises."""
    parts = [
        getattr(found, part) for part in ("Request", "Response", "Goal", "Result", "Feedback") if hasattr(found, part)
    ]
    for part in [found, *parts]:
        meta: Any = type(part)
        meta.__import_type_support__()
        if meta._TYPE_SUPPORT is None:
            raise ImportError(f"its type support for {part.__name__} is missing")


def _registered(package: str) -> frozenset[str] | None:
    """What an interface package registered, as ``msg/Twist.idl``; None when it is not an interface package."""
    for prefix in _prefixes():
        try:
            return frozenset((prefix / _INDEX / package).read_text(encoding="utf-8").split())
        except OSError:
            continue
    return None


def interface_file(name: InterfaceName, file_name: str) -> Path | None:
    """A file that an interface's package installed beside its definition, None when there is none.

    Raises Refused when there is no such interface on this robot.
    """
    interfaces = _registered(name.package)
    if interfaces is None or not {f"{name.kind}/{name.name}.{ending}" for ending in ("idl", name.kind)} & interfaces:
        raise Refused(f"type {name} is not installed on this robot")
    paths = (prefix / "share" / name.package / name.kind / file_name for prefix in _prefixes())
    return next((path for path in paths if path.is_file()), None)


def _prefixes() -> list[Path]:
    """Where ROS packages are installed: what was sourced, and this Python's own prefix for ROS from PyPI."""
    sourced = [Path(prefix) for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    return [*sourced, Path(sys.prefix)]


_PRIMITIVE_BYTES = {
    **dict.fromkeys(("boolean", "octet", "char", "uint8", "int8"), 1),
    **dict.fromkeys(("uint16", "int16", "wchar"), 2),
    **dict.fromkeys(("uint32", "int32", "float"), 4),
    **dict.fromkeys(("uint64", "int64", "double"), 8),
    "long double": 16,
}
_BOXED = frozenset({"boolean", "octet", "char", "wchar"})
"""rclpy has arrays of the other numbers."""


def shape_of(message: type[Any]) -> Structure:
    """What a message class consists of."""
    return Structure(tuple(map(_shape, getattr(message, "SLOT_TYPES", ()))))


def _shape(slot: Any) -> Shape:
    from rosidl_parser import definition as idl  # type: ignore[import-untyped, import-not-found, unused-ignore]

    if isinstance(slot, idl.BasicType):
        return Number(_PRIMITIVE_BYTES.get(slot.typename, 1), slot.typename in _BOXED)
    if isinstance(slot, idl.NamespacedType):
        return shape_of(getattr(importlib.import_module(".".join(slot.namespaces)), slot.name))
    if isinstance(slot, idl.Array):
        return Array(_shape(slot.value_type), int(slot.size))
    bounded = isinstance(slot, idl.BoundedSequence | idl.BoundedString | idl.BoundedWString)
    most = int(slot.maximum_size) if bounded else 0
    if isinstance(slot, idl.AbstractSequence):
        return Sequence(_shape(slot.value_type), most)
    return Text(isinstance(slot, idl.AbstractWString), most)
