"""What robots say that they have: the type behind a topic's or a service's name. Pure."""

from __future__ import annotations

import difflib
from collections.abc import Collection

from ..errors import Unreachable, UsageError
from .messages import Functionality, NodeType

ALIKE = 0.7
"""How alike names are that may be meant by each other, from 0 to 1."""


def type_behind(name: str, kind: NodeType, offers: Collection[Functionality]) -> str:
    """The type of a topic or service, as robots offer it to an interface node of this kind.

    Raises Unreachable when no robot offers it, UsageError when robots offer several types.
    """
    name = absolute(name)
    found = _types(name, kind, offers)
    if len(found) > 1:
        raise UsageError(f"{name} has types {' and '.join(sorted(found))}: say which one is meant")
    if found:
        return found.pop()
    near = closest(name, {known for offered in offers for table in _tables(offered, kind) for known in table})
    meant = f"; did you mean {near}?" if near else "."
    what = "service" if kind == NodeType.CLIENT else "topic"
    raise Unreachable(f"{what} {name}", f"no robot offers it{meant} Or say its type, as pkg/Name")


def _types(name: str, kind: NodeType, offers: Collection[Functionality]) -> set[str]:
    """What the nodes at the other end have, or else those at the same end."""
    for tables in zip(*(_tables(offered, kind) for offered in offers), strict=True):
        if found := {short_type(table[name]) for table in tables if name in table}:
            return found
    return set()


def closest(name: str, known: Collection[str]) -> str:
    """The name that may have been meant, empty when none is alike."""
    return next(iter(difflib.get_close_matches(name, sorted(known), n=1, cutoff=ALIKE)), "")


def absolute(name: str) -> str:
    """A topic's or service's name as robots list it."""
    return name if name.startswith("/") else f"/{name}"


def short_type(of_type: str) -> str:
    """As headsets write it: ``geometry_msgs/msg/Twist`` → ``geometry_msgs/Twist``."""
    package, _, name = of_type.partition("/")
    return f"{package}/{name.rpartition('/')[2]}"


def _tables(offered: Functionality, kind: NodeType) -> list[dict[str, str]]:
    """Where to look: first at the other end of what the interface node has."""
    if kind == NodeType.CLIENT:
        return [offered.services]
    both = [offered.publishers, offered.subscribers]
    return both if kind == NodeType.SUBSCRIBER else both[::-1]
