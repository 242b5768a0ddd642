"""Which quality of service fits which endpoints."""

from __future__ import annotations

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy
from rclpy.qos import qos_check_compatible as check

from bridge.ros import qos
from bridge.ros.rclpy_side import qos_of, rclpy_profile

PLAIN = QoSProfile(depth=5)
SENSOR = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED_SENSOR = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.BEST_EFFORT
)
STRICT = QoSProfile(
    depth=1,
    deadline=Duration(seconds=1),
    liveliness=LivelinessPolicy.MANUAL_BY_TOPIC,
    liveliness_lease_duration=Duration(seconds=2),
)
STRICTER = QoSProfile(depth=1, deadline=Duration(nanoseconds=500_000_000))
MIXES = [[], [PLAIN], [SENSOR], [LATCHED], [LATCHED_SENSOR], [PLAIN, SENSOR], [LATCHED, PLAIN], [STRICT, SENSOR]]
MIXES += [[STRICT, STRICTER, LATCHED], [LATCHED, LATCHED_SENSOR]]


@pytest.mark.parametrize("publishers", MIXES)
def test_a_subscription_matches_all_publishers(publishers: list[QoSProfile]) -> None:
    """ROS itself finds what we ask for compatible with every publisher."""
    profile = rclpy_profile(qos.for_subscription(map(qos_of, publishers), 7))
    assert profile.depth == 7
    assert all(check(offered, profile)[0] != QoSCompatibility.ERROR for offered in publishers)


@pytest.mark.parametrize("subscriptions", MIXES)
@pytest.mark.parametrize("latched", [True, False])
def test_a_publisher_matches_all_subscriptions(subscriptions: list[QoSProfile], latched: bool) -> None:
    """ROS itself finds what we offer compatible with every subscription."""
    profile = rclpy_profile(qos.for_publisher(map(qos_of, subscriptions), 7, latched=latched))
    assert profile.depth == 7
    assert all(check(profile, requested)[0] != QoSCompatibility.ERROR for requested in subscriptions)
    assert not latched or profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


@pytest.mark.parametrize(
    ("publishers", "reliable", "latched"),
    [
        ([], True, False),
        ([PLAIN], True, False),
        ([LATCHED], True, True),
        ([LATCHED, PLAIN], True, False),
        ([SENSOR, PLAIN], False, False),
        ([LATCHED_SENSOR], False, True),
    ],
)
def test_a_subscription_asks_for_as_much_as_there_is(
    publishers: list[QoSProfile], reliable: bool, latched: bool
) -> None:
    """Nothing that all publishers offer is given away."""
    profile = rclpy_profile(qos.for_subscription(map(qos_of, publishers), 7))
    assert (profile.reliability == ReliabilityPolicy.RELIABLE) is reliable
    assert (profile.durability == DurabilityPolicy.TRANSIENT_LOCAL) is latched


@pytest.mark.parametrize(("buffer_size", "depth"), [(0, 10), (1, 1), (500, 500), (10**9, 1000)])
def test_the_buffer_size_is_the_depth(buffer_size: int, depth: int) -> None:
    """A headset's buffer size counts, within what a robot can afford; 0 means that it does not care."""
    assert qos.depth_of(buffer_size) == depth
