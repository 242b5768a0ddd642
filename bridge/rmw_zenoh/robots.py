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
    each of those; else one for the domain. Who has an id keeps it, also while it is away: but a domain's robot, whose
    id is in no name, yields it to a namespace that ends in that number, so that whoever comes first does not matter.
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
        numbered = {
            domain: {name: int(number[0]) for name in sorted(namespaces) if (number := _NUMBER.search(name))}
            for domain, namespaces in sorted(domains.items())
        }
        for domain, ids in numbered.items():
            for namespace, robot_id in ids.items():
                self._take((domain, namespace), robot_id)
        for domain in [domain for domain, ids in numbered.items() if not ids]:
            self._take((domain, "/"), self._first_id + domain)
        replaced = {(domain, "/") for domain, ids in numbered.items() if ids} - set(self._given)
        return [robot for place, robot in self._known.items() if place not in replaced]

    def _take(self, place: Place, robot_id: int) -> None:
        if place in self._known:
            return
        domain, namespace = place
        other = next((each for each, robot in self._known.items() if robot.id == robot_id), None)
        if other is not None and self._yields(other, place):
            self._known.pop(other)
            other = None
        if domain > MAX_DOMAIN or not 1 <= robot_id <= MAX_ID:
            problem = f"{robot_id} is no id of a robot"
        elif other is not None:
            problem = f"id {robot_id} is that of {self._known[other].place}"
        elif len(self._known) >= self.MAX:
            problem = f"there are {self.MAX} robots already"
        else:
            self._known[place] = RmwZenohRobot(id=robot_id, domain=domain, node_namespace=namespace)
            self._refused.pop(place, None)
            return
        if len(self._refused) < self.MAX:
            self._refused[place] = problem

    def _yields(self, place: Place, to: Place) -> bool:
        """Whether a place has its id by its domain alone, and gives it to one that has it in its name."""
        return place not in self._given and place[1] == "/" and to[1] != "/" and to[0] <= MAX_DOMAIN
