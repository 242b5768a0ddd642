"""Which robots there are, by the nodes whose tokens live. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable

from bridge.rmw_zenoh.places import is_within
from bridge.settings.rmw_zenoh import RmwZenohRobot, RmwZenohSettings
from macs_zenoh.protocol.rmw_zenoh.graph import Graph
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Node

Place = tuple[int, str]
"""A domain, and a namespace in it."""

MAX_ID = 0xFFFF
MAX_DOMAIN = 232
_NUMBER = re.compile(r"[0-9]{1,5}$")


def nodes_of(robot: RmwZenohRobot, graph: Graph) -> list[Node]:
    """The nodes of a robot, without our own."""
    return [node for node in graph.nodes(others=True) if is_within(robot.node_namespace, node)]


class Robots:
    """Robots by rule, as nodes come and go: of a domain in which nodes are in namespaces that end in a number, one for
    each of those; else one for the domain. Who has an id keeps it, also while it is away.
    """

    MAX = 256

    def __init__(self, settings: RmwZenohSettings) -> None:
        """The robots of the settings are always among them."""
        self._first_id = settings.first_id
        self._given = {(robot.domain, robot.node_namespace): robot for robot in settings.robots}
        self._known = dict(self._given)
        self._refused: dict[Place, str] = {}

    @property
    def refused(self) -> dict[Place, str]:
        """Domains and namespaces whose nodes are no robot, and why."""
        return dict(self._refused)

    def look(self, nodes: Iterable[Node]) -> list[RmwZenohRobot]:
        """The robots that there are, or were and may be again, now that these nodes are there."""
        domains: dict[int, set[str]] = {}
        for node in nodes:
            domains.setdefault(node.domain, set()).add(f"/{node.namespace.strip('/').partition('/')[0]}")
        replaced: set[Place] = set()
        for domain, namespaces in sorted(domains.items()):
            numbered = sorted(namespace for namespace in namespaces if _NUMBER.search(namespace))
            for namespace in numbered or ["/"]:
                self._take((domain, namespace))
            if numbered and (domain, "/") not in self._given:
                replaced.add((domain, "/"))
        return [robot for place, robot in self._known.items() if place not in replaced]

    def _take(self, place: Place) -> None:
        if place in self._known:
            return
        domain, namespace = place
        number = _NUMBER.search(namespace)
        robot_id = int(number[0]) if number is not None else self._first_id + domain
        other = next((robot for robot in self._known.values() if robot.id == robot_id), None)
        if domain > MAX_DOMAIN or not 1 <= robot_id <= MAX_ID:
            problem = f"{robot_id} is no id of a robot"
        elif other is not None:
            problem = f"id {robot_id} is that of {other.place}"
        elif len(self._known) >= self.MAX:
            problem = f"there are {self.MAX} robots already"
        else:
            self._known[place] = RmwZenohRobot(id=robot_id, domain=domain, node_namespace=namespace)
            self._refused.pop(place, None)
            return
        if len(self._refused) < self.MAX:
            self._refused[place] = problem
