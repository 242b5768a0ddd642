"""macs-zenoh: a Zenoh mesh on which ROS 2 robots and XR headsets reach each other by id, by group or all at once.

What is listed here is the public interface. It is loaded when it is used: a command line that only prints its help
needs no Zenoh.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .agent import Agent as Agent
    from .agent import Call as Call
    from .agent import join as join
    from .config import MeshSettings as MeshSettings
    from .config import TrafficRule as TrafficRule
    from .errors import CallTimeout as CallTimeout
    from .errors import ConfigError as ConfigError
    from .errors import MacsError as MacsError
    from .errors import OutOfRange as OutOfRange
    from .errors import Refused as Refused
    from .errors import TooManyDestinations as TooManyDestinations
    from .errors import Unreachable as Unreachable
    from .errors import UsageError as UsageError
    from .protocol.directory import AgentInfo as AgentInfo
    from .protocol.messages import Metadata as Metadata
    from .protocol.messages import NodeType as NodeType
    from .protocol.reading import Message as Message

_WHERE = {
    "agent": ("Agent", "Call", "join"),
    "config": ("MeshSettings", "TrafficRule"),
    "protocol.directory": ("AgentInfo",),
    "errors": (
        "CallTimeout",
        "ConfigError",
        "MacsError",
        "OutOfRange",
        "Refused",
        "TooManyDestinations",
        "Unreachable",
        "UsageError",
    ),
    "protocol.messages": ("Metadata", "NodeType"),
    "protocol.reading": ("Message",),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}

__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from .versions import installed

        return installed("macs-zenoh")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f".{_MODULES[name]}", __name__), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
