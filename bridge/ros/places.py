"""Which interface node the name in a message means. Pure.

Nodes are kept by what they work on, the full name of a topic, service or action: its rules, its control and its
dead-man are one, under whatever name it was registered (``cmd_vel``, ``/cmd_vel``, or remapped). Messages only say a
*node name*, and different topics can have the same one (``/cmd/vel`` and ``/cmd_vel``): so each sender's messages go
to the node that it registered under that name. Those of a sender that never registered go there as long as the name
can mean one node only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

from bridge.ros.early import NodeKey
from bridge.ros.interface import Registrant


class Named(Protocol):
    """What a place needs to know of a node."""

    alike: bool
    """Whether the robot knows another topic with the same node name."""


NodeT = TypeVar("NodeT", bound=Named)


@dataclass
class _Name(Generic[NodeT]):
    """One node name: its nodes, and who means which."""

    nodes: list[NodeT] = field(default_factory=list)
    of: dict[Registrant, NodeT] = field(default_factory=dict)

    @property
    def sole(self) -> NodeT | None:
        """The node for everybody, registered or not."""
        return self.nodes[0] if len(self.nodes) == 1 and not self.nodes[0].alike else None


class Places(Generic[NodeT]):
    """All names, by node type and node name."""

    def __init__(self) -> None:
        self._names: dict[NodeKey, _Name[NodeT]] = {}
        self._sole: dict[NodeKey, NodeT] = {}

    def sole(self, key: NodeKey) -> NodeT | None:
        """The node that a name means whoever says it; None where that depends, or where there is none."""
        return self._sole.get(key)

    def of(self, key: NodeKey, registrant: Registrant) -> NodeT | None:
        """The node that an agent registered under a name."""
        name = self._names.get(key)
        return name.of.get(registrant) if name is not None else None

    def first(self, key: NodeKey) -> NodeT | None:
        """The oldest node of a name."""
        name = self._names.get(key)
        return name.nodes[0] if name is not None else None

    def all_of(self, key: NodeKey) -> list[NodeT]:
        """All nodes of a name."""
        name = self._names.get(key)
        return list(name.nodes) if name is not None else []

    def names_of(self, node: NodeT, registrant: Registrant) -> Iterator[NodeKey]:
        """The names under which an agent registered a node."""
        return (key for key, name in self._names.items() if name.of.get(registrant) is node)

    def bind(self, key: NodeKey, node: NodeT, registrant: Registrant | None = None) -> None:
        """A node has this name; and this agent means it by that."""
        name = self._names.setdefault(key, _Name())
        if node not in name.nodes:
            name.nodes.append(node)
        if registrant is not None:
            name.of[registrant] = node
        self._look(key)

    def unbind(self, node: NodeT, registrant: Registrant, key: NodeKey | None = None) -> None:
        """An agent does not mean a node by a name any more; None: by none."""
        for own in [key] if key is not None else list(self.names_of(node, registrant)):
            if self.of(own, registrant) is node:
                del self._names[own].of[registrant]

    def remove(self, node: NodeT) -> None:
        """A node is gone."""
        for key, name in list(self._names.items()):
            if node in name.nodes:
                name.nodes.remove(node)
                name.of = {registrant: meant for registrant, meant in name.of.items() if meant is not node}
                if not name.nodes:
                    del self._names[key]
                self._look(key)

    def look(self, node: NodeT) -> None:
        """A node may have become ``alike``."""
        for key, name in self._names.items():
            if node in name.nodes:
                self._look(key)

    def _look(self, key: NodeKey) -> None:
        """A dictionary of its own: messages are looked up in it in Zenoh's threads."""
        name = self._names.get(key)
        sole = name.sole if name is not None else None
        if sole is not None:
            self._sole[key] = sole
        else:
            self._sole.pop(key, None)
