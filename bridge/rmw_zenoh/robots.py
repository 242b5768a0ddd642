"""Which robots there are, by the nodes whose tokens live. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from bridge.rmw_zenoh.places import is_within
from bridge.settings.rmw_zenoh import RmwZenohRobot, RmwZenohSettings
from macs_zenoh.protocol.rmw_zenoh.graph import Graph
from macs_zenoh.protocol.rmw_zenoh.keyexpr import Node

MAX_ID = 0xFFFF
_NUMBER = re.compile(r"[0-9]{1,5}$")


def nodes_of(robot: RmwZenohRobot, graph: Graph) -> list[Node]:
    """The nodes of a robot, without our own."""
    return [node for node in graph.nodes(others=True) if is_within(robot.node_namespace, node)]


def seen(settings: RmwZenohSettings, nodes: Iterable[Node]) -> Iterator[RmwZenohRobot]:
    """Robots by rule: of a domain in which nodes are in namespaces that end in a number, one for each of those; else
    one for the domain."""
    domains: dict[int, set[str]] = {}
    for node in nodes:
        domains.setdefault(node.domain, set()).add(f"/{node.namespace.strip('/').partition('/')[0]}")
    taken: set[int] = set()
    for domain, namespaces in sorted(domains.items()):
        numbered = sorted(namespace for namespace in namespaces if _NUMBER.search(namespace))
        for namespace in numbered or ["/"]:
            number = _NUMBER.search(namespace)
            robot_id = int(number[0]) if number is not None else settings.first_id + domain
            if 1 <= robot_id <= MAX_ID and robot_id not in taken:
                taken.add(robot_id)
                yield RmwZenohRobot(id=robot_id, domain=domain, node_namespace=namespace)
