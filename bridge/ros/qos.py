"""Quality of service taken from a topic's other endpoints, so that every topic can be joined as it is. Pure.

Facts used (ROS 2 design, "QoS policies"): a subscription matches when every policy that it requests is at most what
the publisher offers; best effort < reliable, volatile < transient local, and a shorter deadline is the stronger one.
"""

from __future__ import annotations

from collections.abc import Iterable

from msgspec import structs

from bridge.settings import TopicRule
from macs_zenoh.protocol.rmw_zenoh.qos import ENDLESS_NS, Durability, Liveliness, Qos, Reliability

DEFAULT_DEPTH = 10
MAX_DEPTH = 1000
"""A headset chooses the depth; memory for it is the robot's."""


def depth_of(buffer_size: int) -> int:
    """The history depth for a registration's ``bufferSize``; 0 is what a headset sends that does not care."""
    return min(buffer_size, MAX_DEPTH) or DEFAULT_DEPTH


def for_subscription(publishers: Iterable[Qos], depth: int) -> Qos:
    """What a subscription must request to match all ``publishers``, and no less.

    One best-effort publisher makes it best effort; all of them must be transient local to ask for the last messages.
    """
    offered = list(publishers)
    best_effort = any(qos.reliability == Reliability.BEST_EFFORT for qos in offered)
    latched = bool(offered) and all(map(is_latched, offered))
    return Qos(
        depth=depth,
        reliability=Reliability.BEST_EFFORT if best_effort else Reliability.RELIABLE,
        durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
    )


def best_effort(depth: int) -> Qos:
    """What matches every publisher, but asks none for its last messages."""
    return Qos(depth=depth, reliability=Reliability.BEST_EFFORT, durability=Durability.VOLATILE)


def for_publisher(subscriptions: Iterable[Qos], depth: int, *, latched: bool) -> Qos:
    """What a publisher must offer to match all ``subscriptions``.

    Reliable always: it serves best-effort subscriptions too. A stricter deadline or liveliness is taken over.
    """
    requested = list(subscriptions)
    latched = latched or any(map(is_latched, requested))
    manual = any(qos.liveliness == Liveliness.MANUAL_BY_TOPIC for qos in requested)
    return Qos(
        depth=depth,
        durability=Durability.TRANSIENT_LOCAL if latched else Durability.VOLATILE,
        liveliness=Liveliness.MANUAL_BY_TOPIC if manual else Liveliness.AUTOMATIC,
        deadline_ns=_shortest(qos.deadline_ns for qos in requested),
        lease_ns=_shortest(qos.lease_ns for qos in requested),
    )


def is_latched(qos: Qos) -> bool:
    """Whether a publisher holds its last messages for subscriptions that come later."""
    return qos.durability == Durability.TRANSIENT_LOCAL


def for_each_of(publishers: int, qos: Qos) -> Qos:
    """A subscription's profile with room for what each of so many publishers latches, not only one of them."""
    if not is_latched(qos):
        return qos
    return structs.replace(qos, depth=min(qos.depth * max(1, publishers), max(MAX_DEPTH, qos.depth)))


def overridden(qos: Qos, rule: TopicRule) -> Qos:
    """The profile with what a robot's settings ask for."""
    return structs.replace(
        qos,
        reliability=Reliability[rule.reliability.upper()] if rule.reliability is not None else qos.reliability,
        durability=Durability[rule.durability.upper()] if rule.durability is not None else qos.durability,
        depth=rule.depth if rule.depth is not None else qos.depth,
    )


def same(one: Qos, other: Qos) -> bool:
    """Whether two profiles made here ask for the same."""
    return one.reliability == other.reliability and one.durability == other.durability


def _shortest(durations: Iterable[int]) -> int:
    """The shortest real duration (0 and endless mean: no such policy)."""
    return min((duration for duration in durations if 0 < duration < ENDLESS_NS), default=ENDLESS_NS)
