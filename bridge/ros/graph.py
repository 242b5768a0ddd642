"""What a robot offers: its topics and services, without our own and without ROS's plumbing."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.node import NodeNameNonExistentError
from rclpy.topic_or_service_is_hidden import topic_or_service_is_hidden

from macs_zenoh.messages import Functionality

PLUMBING_TOPICS = frozenset({"/rosout", "/parameter_events"})
PLUMBING_PACKAGES = ("rcl_interfaces/", "type_description_interfaces/", "lifecycle_msgs/")
"""Every ROS node brings services of these types; they are its parameters and states, not what the robot does."""

NamesAndTypes = list[tuple[str, list[str]]]


def offers(node: Any) -> Functionality:
    """The graph around ``node`` now: topics that others subscribe and publish, services that they serve.

    Each name with its type (``geometry_msgs/msg/Twist``); the first by alphabet where a topic has several. To be
    called in the ROS thread.
    """
    own = (node.get_name(), node.get_namespace())
    others = [other for other in set(node.get_node_names_and_namespaces()) if other != own]
    return Functionality(
        subscribers=_gather(node.get_subscriber_names_and_types_by_node, others),
        publishers=_gather(node.get_publisher_names_and_types_by_node, others),
        services=_gather(node.get_service_names_and_types_by_node, others),
    )


def _gather(ask: Callable[[str, str], NamesAndTypes], nodes: Iterable[tuple[str, str]]) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, namespace in nodes:
        try:
            entries = ask(name, namespace)
        except NodeNameNonExistentError:  # it left between the two questions
            continue
        for topic, types in entries:
            if types and not _is_plumbing(topic, types):
                found[topic] = min(types)
    return dict(sorted(found.items()))


def _is_plumbing(name: str, types: list[str]) -> bool:
    return (
        name in PLUMBING_TOPICS
        or bool(topic_or_service_is_hidden(name))
        or all(of_type.startswith(PLUMBING_PACKAGES) for of_type in types)
    )
