"""Where nodes are. Pure."""

from __future__ import annotations

from macs_zenoh.protocol.rmw_zenoh.keyexpr import Node


def is_within(namespace: str, node: Node) -> bool:
    """Whether a node is in a namespace, or below it."""
    return namespace == "/" or f"{node.namespace}/".startswith(f"{namespace}/")
