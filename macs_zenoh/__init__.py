"""macs-zenoh: a Zenoh mesh on which ROS 2 robots and XR headsets reach each other by id, by group or all at once.

What is listed here is the public interface. It is loaded when it is used: a command line that only prints its help
needs no Zenoh, and only who uses `GatewayClient` needs rclpy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bridge.awareness.afferent import GatewayClientAfferent as GatewayClientAfferent
    from bridge.awareness.afferent import Mode as Mode
    from bridge.awareness.client import GatewayClient as GatewayClient
    from bridge.headset.client import Headset as Headset
    from bridge.headset.stream import Way as Way

    from .agent import Agent as Agent
    from .config import MeshSettings as MeshSettings
    from .config import TrafficRule as TrafficRule
    from .errors import BadField as BadField
    from .errors import BadJson as BadJson
    from .errors import BadSizes as BadSizes
    from .errors import CallTimeout as CallTimeout
    from .errors import Closed as Closed
    from .errors import ConfigError as ConfigError
    from .errors import FrameTooLarge as FrameTooLarge
    from .errors import HeldByAnother as HeldByAnother
    from .errors import MacsError as MacsError
    from .errors import MissingExtra as MissingExtra
    from .errors import NotAdmitted as NotAdmitted
    from .errors import NotAllowed as NotAllowed
    from .errors import NotPermitted as NotPermitted
    from .errors import NotServed as NotServed
    from .errors import OutOfRange as OutOfRange
    from .errors import Refused as Refused
    from .errors import TooFast as TooFast
    from .errors import TooLong as TooLong
    from .errors import TooManyDestinations as TooManyDestinations
    from .errors import UnknownManager as UnknownManager
    from .errors import Unreachable as Unreachable
    from .errors import UsageError as UsageError
    from .errors import WireError as WireError
    from .handles import Handle as Handle
    from .joining import join as join
    from .protocol.agent_id import AgentId as AgentId
    from .protocol.directory import AgentInfo as AgentInfo
    from .protocol.messages import Metadata as Metadata
    from .protocol.messages import NodeType as NodeType
    from .protocol.reading import Message as Message
    from .serving import Call as Call
    from .topics import TopicMessage as TopicMessage
    from .topics import TopicPublisher as TopicPublisher
    from .topics import TopicSubscription as TopicSubscription
    from .typed import BadCdr as BadCdr
    from .typed import BadValue as BadValue
    from .typed import Types as Types
    from .typed import UnknownType as UnknownType
    from .typed import request_of as request_of
    from .typed import response_of as response_of

_WHERE = {
    "bridge.awareness.afferent": ("GatewayClientAfferent", "Mode"),
    "bridge.awareness.client": ("GatewayClient",),
    "bridge.headset.client": ("Headset",),
    "bridge.headset.stream": ("Way",),
    "macs_zenoh.agent": ("Agent",),
    "macs_zenoh.config": ("MeshSettings", "TrafficRule"),
    "macs_zenoh.errors": (
        "BadField",
        "BadJson",
        "BadSizes",
        "CallTimeout",
        "Closed",
        "ConfigError",
        "FrameTooLarge",
        "HeldByAnother",
        "MacsError",
        "MissingExtra",
        "NotAdmitted",
        "NotAllowed",
        "NotPermitted",
        "NotServed",
        "OutOfRange",
        "Refused",
        "TooFast",
        "TooLong",
        "TooManyDestinations",
        "UnknownManager",
        "Unreachable",
        "UsageError",
        "WireError",
    ),
    "macs_zenoh.handles": ("Handle",),
    "macs_zenoh.joining": ("join",),
    "macs_zenoh.protocol.agent_id": ("AgentId",),
    "macs_zenoh.protocol.directory": ("AgentInfo",),
    "macs_zenoh.protocol.messages": ("Metadata", "NodeType"),
    "macs_zenoh.protocol.reading": ("Message",),
    "macs_zenoh.serving": ("Call",),
    "macs_zenoh.topics": ("TopicMessage", "TopicPublisher", "TopicSubscription"),
    "macs_zenoh.typed": ("BadCdr", "BadValue", "Types", "UnknownType", "request_of", "response_of"),
}
_MODULES = {name: module for module, names in _WHERE.items() for name in names}

__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from .versions import installed

        return installed("macs-zenoh")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
