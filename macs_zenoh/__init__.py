"""macs-zenoh: a Zenoh mesh on which ROS 2 robots and XR headsets reach each other by id, by group or all at once."""

from .agent import Agent, Call, join
from .config import MeshSettings, TrafficRule
from .directory import AgentInfo
from .errors import MacsError, Refused, Unreachable
from .messages import Metadata, NodeType
from .reading import Message

__all__ = [
    "Agent",
    "AgentInfo",
    "Call",
    "MacsError",
    "MeshSettings",
    "Message",
    "Metadata",
    "NodeType",
    "Refused",
    "TrafficRule",
    "Unreachable",
    "join",
]
