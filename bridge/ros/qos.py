"""Quality of service taken from a topic's other endpoints, so that every topic can be joined as it is.

Facts used (ROS 2 design, "QoS policies"): a subscription matches when every policy that it requests is at most what
the publisher offers; best effort < reliable, volatile < transient local, and a shorter deadline is the stronger one.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from bridge.settings import TopicRule

DEFAULT_DEPTH = 10
MAX_DEPTH = 1000
"""A headset chooses the depth; memory for it is the robot's."""


def depth_of(buffer_size: int) -> int:
    """The history depth for a registration's ``bufferSize``; 0 is what a headset sends that does not care."""
    return min(buffer_size, MAX_DEPTH) or DEFAULT_DEPTH


def for_subscription(publishers: Iterable[Any], depth: int) -> QoSProfile:
    """What a subscription must request to match all ``publishers`` (their QoS profiles), and no less.

    One best-effort publisher makes it best effort; all of them must be transient local to ask for the last messages.
    """
    offered = list(publishers)
    best_effort = any(qos.reliability == ReliabilityPolicy.BEST_EFFORT for qos in offered)
    latched = bool(offered) and all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def for_publisher(subscriptions: Iterable[Any], depth: int, *, latched: bool) -> QoSProfile:
    """What a publisher must offer to match all ``subscriptions`` (their QoS profiles).

    Reliable always: it serves best-effort subscriptions too. A stricter deadline or liveliness is taken over.
    """
    requested = list(subscriptions)
    latched = latched or any(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in requested)
    manual = any(qos.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC for qos in requested)
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC if manual else LivelinessPolicy.AUTOMATIC,
    )
    if deadline := _shortest(qos.deadline for qos in requested):
        profile.deadline = deadline
    if lease := _shortest(qos.liveliness_lease_duration for qos in requested):
        profile.liveliness_lease_duration = lease
    return profile


def is_latched(profile: QoSProfile) -> bool:
    """Whether a publisher holds its last messages for subscriptions that come later."""
    return bool(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)


def for_each_of(publishers: int, profile: QoSProfile) -> QoSProfile:
    """A subscription's profile with room for what each of so many publishers latches, not only one of them."""
    if is_latched(profile):
        profile.depth = min(profile.depth * max(1, publishers), max(MAX_DEPTH, profile.depth))
    return profile


def overridden(profile: QoSProfile, rule: TopicRule) -> QoSProfile:
    """The profile with what a robot's settings ask for."""
    if rule.reliability is not None:
        profile.reliability = ReliabilityPolicy[rule.reliability.upper()]
    if rule.durability is not None:
        profile.durability = DurabilityPolicy[rule.durability.upper()]
    if rule.depth is not None:
        profile.depth = rule.depth
    return profile


def same(one: QoSProfile, other: QoSProfile) -> bool:
    """Whether two profiles made here ask for the same."""
    return bool(one.reliability == other.reliability and one.durability == other.durability)


_ENDLESS_NS = (1 << 62) - 1
"""Middlewares report "no deadline" as their own largest duration, hundreds of years."""


def _shortest(durations: Iterable[Any]) -> Duration | None:
    """The shortest real duration, None when there is none (0 and endless mean: no such policy)."""
    real = [duration.nanoseconds for duration in durations if 0 < duration.nanoseconds < _ENDLESS_NS]
    return Duration(nanoseconds=min(real)) if real else None
