"""A robot's topic data on the mesh: what the robot bridge puts, once for all who are registered."""

from __future__ import annotations

from .agent import Agent
from .config import Priority
from .mesh import Traffic
from .protocol.keyexpr import STREAM

KNOWN = 4096
"""Names of interface nodes whose keys are remembered."""


class Streams:
    """The stream keys of one robot, one for each interface node. All methods may be called from any thread."""

    def __init__(self, agent: Agent) -> None:
        self._agent = agent
        self._mesh = agent.mesh
        self._keys: dict[str, str] = {}
        agent.on_id(self._id_changed)

    def publish(self, node: str, frame: bytes) -> None:
        """Put topic data. ``frame`` is a whole frame whose management data lists who gets it (StreamData)."""
        self._mesh.put(self._keys.get(node) or self._key(node), frame, Traffic.STREAM)

    def prioritise(self, node: str, priority: Priority | None) -> None:
        """Put a node's topic data at this priority; None: at the usual one."""
        self._mesh.prioritise(self._key(node), priority)

    def keep(self, node: str, frames: int | None) -> bool:
        """Keep so many frames of a node's topic data for receivers that miss some; None: as the traffic rules say.
        Returns whether any are kept."""
        return self._mesh.keep(self._key(node), frames)

    def _key(self, node: str) -> str:
        key = self._keys.get(node)
        if key is None:
            if len(self._keys) >= KNOWN:  # names come from the network
                self._keys = {}
            key = self._keys[node] = STREAM.of(type=self._agent.type_number, id=self._agent.id, node=node)
        return key

    def _id_changed(self, _old: int, _new: int) -> None:
        self._keys = {}
